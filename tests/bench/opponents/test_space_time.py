"""Fields of space and time: the flow's derivatives, the matter's, what is seen of them, and states."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
import torch

from helpers.jets import curl, jet_of
from holosplat.checks import InputError
from holosplat.geometry import Grid, Views
from holosplat.matter import Matter
from holosplat_bench.opponents.fields import SpaceTime, SpaceTimeField
from holosplat_bench.opponents.fields.perceptron import VelocityNetwork
from holosplat_bench.opponents.fields.space_time import Frame

PITCH = 2e-6
GRID = Grid((9, 7, 13), (PITCH, PITCH, PITCH), (-11e-6, -7e-6, -8e-6))
"""Rectangular, odd, and not about the origin."""
ONE = Matter.one(3e-7, 2e-10)
TIMES = np.array([1e-3, 2e-3, 4e-3])


def a_field(solenoidal: bool = True, **options: object) -> SpaceTimeField:
    """In float64, with a flow that moves."""
    torch.manual_seed(0)
    how = SpaceTime(velocity=VelocityNetwork(solenoidal, hidden=7), **options)  # pyright: ignore[reportArgumentType]
    found = SpaceTimeField.still(torch.rand(3, *GRID.shape), GRID, TIMES, ONE, how, seed=2)
    return found.with_parameters({n: torch.randn_like(p).double() for n, p in found.parameters().items()})


def places(count: int = 40) -> torch.Tensor:
    """In the field, in the units of its frame."""
    reach = torch.tensor([1.0, 7 / 13, 9 / 13], dtype=torch.float64)
    return (2 * torch.rand(count, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) - 1) * reach


def network(field: SpaceTimeField, at: torch.Tensor) -> torch.Tensor:
    """The outputs of the perceptron at points [P, 4], as its formula says."""
    hidden = at
    for k in range(2):
        hidden = torch.tanh(hidden @ field.weights[f"weight{k}"].T + field.weights[f"bias{k}"])
    return hidden @ field.weights["weight2"].T + field.weights["bias2"]


@pytest.mark.parametrize("solenoidal", [True, False])
def test_derivatives_of_the_flow_are_those_of_automatic_differentiation(solenoidal):
    field, time = a_field(solenoidal), 0.3
    flow, pressure = field.flow(places(), time, curved=True)
    at = torch.cat([places(), torch.full((40, 1), time, dtype=torch.float64)], 1)
    wanted = jet_of(curl(partial(network, field)) if solenoidal else lambda q: network(field, q)[:, :3], at)
    for ours, theirs in zip(flow, wanted, strict=True):
        assert ours is not None
        assert theirs is not None
        torch.testing.assert_close(ours, theirs, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(pressure.slope, jet_of(lambda q: network(field, q)[:, 3], at).slope)
    torch.testing.assert_close(field.velocities(places(), time), flow.value)


def test_a_curl_has_no_divergence():
    """To rounding, whatever the weights; three free components have one."""
    left = [a_field(kind).flow(places(), -0.2)[0].slope.diagonal(dim1=1, dim2=2).sum(-1) for kind in (True, False)]
    assert float(left[0].abs().max()) < 1e-13
    assert float(left[1].abs().max()) > 0.1


@pytest.mark.parametrize("upper", [0.8, 0.0])
def test_derivatives_of_the_matter_are_those_of_finite_differences(upper):
    """Errors fall with the square of the step."""
    field, time = a_field(), 0.3
    field.upper = upper
    density = field.density(places(), time)

    def errors(step: float) -> torch.Tensor:
        def between(way: torch.Tensor, when: float) -> torch.Tensor:
            ends = [field.density(places() + s * way, time + s * when).value for s in (step, -step)]
            return (ends[0] - ends[1]) / (2 * step)

        unit, still = torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
        found = torch.stack([between(way, 0.0) for way in unit] + [between(still, 1.0)], 1)
        return (found - torch.cat([density.slope, density.rate[:, None]], 1)).abs().amax()

    coarse, fine = errors(1e-3), errors(5e-4)
    assert 3.7 < float(coarse / fine) < 4.3


def test_voxels_are_the_field_at_their_centres():
    field = a_field()
    x, y, z = (torch.from_numpy(axis) for axis in GRID.axes())
    points = torch.stack(torch.meshgrid(z, y, x, indexing="ij")[::-1], -1).reshape(-1, 3)
    wanted = field.density(field.frame.places(points), field.frame.time(2.5e-3)).value
    found = field.with_parameters({n: p.float() for n, p in field.parameters().items()}).at(2.5e-3)
    torch.testing.assert_close(found.values.flatten().double(), wanted, rtol=1e-4, atol=1e-5)


def test_a_field_that_begins_at_volumes_is_near_them():
    """Of a ball that moves, at its times and between them."""
    x, y, z = (axis / PITCH for axis in GRID.axes())

    def ball(time: float) -> torch.Tensor:
        away = np.sqrt((x - 2.5 + time / 2e-3) ** 2 + y[:, None] ** 2 + z[:, None, None] ** 2)
        return torch.from_numpy(1 / (1 + np.exp(2 * (away - 2.5)))).float()

    for pieces, times in ((0, (*TIMES, 3e-3)), (5, TIMES)):  # with five pieces, there are more coefficients than times
        how = SpaceTime(cell_px=1.0, pieces=pieces)
        field = SpaceTimeField.still(torch.stack([ball(t) for t in TIMES]), GRID, TIMES, ONE, how)
        assert field.basis.count == (7 if pieces else 3)
        for time in times:
            away = field.values(float(time)) - ball(time)
            assert float(away.abs().max()) < 0.12
            assert float(away.square().mean().sqrt()) < 0.02


def test_velocity_is_in_metres_a_second():
    """A uniform flow of the network, w half edges in half the scan, is w · 13 µm / 1.5 ms."""
    field = a_field(solenoidal=False)
    still = {n: torch.zeros_like(p) for n, p in field.parameters().items()}
    still["flow.bias2"] = torch.tensor([0.5, -1.0, 0.25, 3.0], dtype=torch.float64)
    found = field.with_parameters(still).velocity(torch.tensor(GRID.centre)[None], 2e-3)
    assert found[0].numpy() == pytest.approx(np.array([0.5, -1.0, 0.25]) * 13e-6 / 1.5e-3, rel=1e-12)
    assert Frame.of(GRID, field.basis).seconds(-1.0) == pytest.approx(1e-3, rel=1e-12)


def test_projections_have_gradients_and_are_those_of_the_voxels():
    field = a_field()
    field = field.with_parameters({n: p.float().requires_grad_() for n, p in field.parameters().items()})
    views = Views.from_angles([0.0, 35.0], (11, 14), PITCH)
    lines = field.at(2e-3).project(views)
    mass = float(field.voxelise(GRID).delta.sum()) * PITCH**3
    assert float(field.project(views)[1][0].detach().sum()) * PITCH**2 == pytest.approx(mass, rel=0.1, abs=0)
    lines[1].sum().backward()
    assert field.coefficients.grad is not None
    assert float(field.coefficients.grad.abs().max()) > 0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"matter": Matter.free(3e-7, 2e-10)}, "needs one material"),
        ({"coefficients": torch.zeros(2, 3, 3, 3)}, "coefficients of a space-time field must have the shape"),
        ({"weights": {}}, "weight0 of a space-time field must have the shape"),
        ({"grid": Grid(GRID.shape, (PITCH, PITCH, 2 * PITCH), GRID.origin)}, "cubic voxels"),
        ({"upper": -1.0}, "upper must not be negative"),
    ],
)
def test_what_does_not_fit_is_refused(change, message):
    field = a_field()
    whole = {"coefficients": field.coefficients, "weights": field.weights, "grid": GRID, "basis": field.basis}
    with pytest.raises(InputError, match=message):
        SpaceTimeField(**({**whole, "matter": ONE} | change))
