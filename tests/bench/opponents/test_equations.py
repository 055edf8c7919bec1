"""Equations of motion of space-time fields: flows that obey them leave nothing, and others what they should."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from helpers.jets import jet_of
from holosplat.fit.problem import Batch
from holosplat.geometry import Grid, Views
from holosplat.matter import Matter
from holosplat.model import Instrument, Model
from holosplat.scan import Exposures
from holosplat_bench.opponents.fields import SpaceTime, SpaceTimeField
from holosplat_bench.opponents.fields.perceptron import Jet, VelocityNetwork
from holosplat_bench.opponents.fields.terms import (
    Equations,
    EquationTerm,
    SpaceTimeVariation,
    continuity,
    divergence,
    momentum,
)

PITCH, ONE = 1e-6, Matter.one(3e-7, 2e-10)
RE = 3.0
NOW = Batch(None, torch.zeros(3), torch.tensor(0.0), 0)


def points(count: int = 60) -> torch.Tensor:
    return 2 * torch.rand(count, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) - 1


def vortices(q: torch.Tensor) -> torch.Tensor:
    """Velocity and pressure of Taylor's decaying vortices (Taylor & Green 1937) at a point [4], with kx = ky = π."""
    x, y, _, t = q.unbind(1)
    fade = torch.exp(-2 * math.pi**2 * t / RE)
    u, v = torch.sin(math.pi * x) * torch.cos(math.pi * y), -torch.cos(math.pi * x) * torch.sin(math.pi * y)
    pressure = 0.25 * RE * (torch.cos(2 * math.pi * x) + torch.cos(2 * math.pi * y)) * fade**2
    return torch.stack([u * fade, v * fade, 0 * x, pressure], 1)


def channel(q: torch.Tensor) -> torch.Tensor:
    """Poiseuille's flow along y between plates x = ±1, and its pressure."""
    x, y, _, _ = q.unbind(1)
    return torch.stack([0 * x, 1 - x**2, 0 * x, -2 * y], 1)


def parts(flow) -> tuple[Jet, Jet]:
    both = jet_of(flow, points())
    return Jet(*(one[:, :3] for one in both)), Jet(*(one[:, 3] for one in both))  # pyright: ignore[reportOptionalSubscript]


def carried(back):
    """A lump that a motion carries, whose inverse is `back`: (places [P, 3], times [P]) → the place at time 0."""
    return lambda q: torch.exp(-(((back(q[:, :3], q[:, 3]) - 0.2) / 0.4) ** 2).sum(1))


def drift(time: torch.Tensor) -> torch.Tensor:
    return time[:, None] * torch.tensor([0.3, 0.1, -0.2], dtype=time.dtype)


def turned(place: torch.Tensor, time: torch.Tensor) -> torch.Tensor:
    """A turn about z by 0.7 t, and a drift."""
    x, y, z = (place - drift(time)).unbind(1)
    c, s = torch.cos(0.7 * time), torch.sin(0.7 * time)
    return torch.stack([c * x + s * y, c * y - s * x, z], 1)


def turning(q: torch.Tensor) -> torch.Tensor:
    """The velocity of that motion."""
    x, y, _ = (q[:, :3] - drift(q[:, 3])).unbind(1)
    return torch.stack([0.3 - 0.7 * y, 0.1 + 0.7 * x, -0.2 + 0 * x], 1)


def growing(q: torch.Tensor) -> torch.Tensor:
    """v = x/2: matter thins out by exp(-3t/2)."""
    return 0.5 * q[:, :3]


CARRIED = {
    "turning": (carried(turned), turning),
    "in a channel": (
        carried(lambda x, t: x - torch.stack([0 * t, t * (1 - x[:, 0] ** 2), 0 * t], 1)),
        lambda q: channel(q)[:, :3],
    ),
    "growing": (
        lambda q: carried(lambda x, t: x * torch.exp(-0.5 * t)[:, None])(q) * torch.exp(-1.5 * q[:, 3]),
        growing,
    ),
}


@pytest.mark.parametrize("name", CARRIED)
def test_matter_that_is_carried_is_continuous(name):
    density, velocity = (jet_of(one, points()) for one in CARRIED[name])
    assert float(continuity(density, velocity).abs().max()) < 1e-13
    assert float(continuity(density, velocity._replace(value=1.1 * velocity.value)).abs().max()) > 0.01
    assert float(divergence(velocity).abs().max()) == pytest.approx(1.5 if name == "growing" else 0, abs=1e-13)


def test_taylors_vortices_obey_navier_and_stokes():
    flow, pressure = parts(vortices)
    size = float(flow.curved.abs().max())  # pyright: ignore[reportOptionalMemberAccess]
    assert float(momentum(flow, pressure, RE).abs().max()) < 1e-13 * size
    assert float(momentum(flow, pressure, 1.1 * RE).abs().max()) > 0.01 * size
    assert float(momentum(flow, pressure).abs().max()) > 0.1 * size


def test_a_channel_obeys_stokes_with_its_pressure_alone():
    flow, pressure = parts(channel)
    assert float(momentum(flow, pressure).abs().max()) < 1e-14
    assert float(momentum(flow, pressure, RE).abs().max()) < 1e-14  # it does not accelerate
    still = pressure._replace(slope=0 * pressure.slope)
    assert float(momentum(flow, still).norm(dim=1).mean()) == pytest.approx(2.0, rel=1e-12)


def splines(cell: float, times: int, degree: int) -> SpaceTimeField:
    """The field whose occupancies at voxels and times are those of a lump that turns, float64."""
    shape = (13, 19, 15)
    grid, when = Grid.centred(shape, PITCH), np.linspace(0.0, 2e-3, times)
    start = SpaceTimeField.still(torch.rand(times, *shape), grid, when, ONE, SpaceTime(cell, degree), upper=0.0)
    z, y, x = (torch.from_numpy(axis / PITCH / 9.5) for axis in grid.axes()[::-1])
    place = torch.stack(torch.meshgrid(z, y, x, indexing="ij")[::-1], -1).reshape(-1, 3)
    values = []
    for t in np.linspace(-1, 1, times):
        at = torch.cat([place, torch.full((len(place), 1), t)], 1)
        values.append(CARRIED["turning"][0](at).reshape(shape))
    values = torch.stack(values)
    raw = values + torch.log(-torch.expm1(-values))
    axes = [torch.linalg.pinv(axis.double()) for axis in start._axes]
    nodes = torch.einsum("tzyx,az,by,cx->tabc", raw, *axes)
    fitted = torch.from_numpy(start.basis.fitted(when, nodes.numpy()))
    return start.with_parameters({"coefficients": fitted})


def left_by(field: SpaceTimeField) -> float:
    """Root mean square of what continuity leaves where the lump is, with its exact velocity, at several times."""
    places, squares = 0.4 * points(100)[:, :3] + 0.1, []
    for time in (-0.62, -0.31, 0.04, 0.27, 0.55):
        at = torch.cat([places, torch.full((100, 1), time, dtype=torch.float64)], 1)
        velocity = turning(at)
        density = field.density(places, time)
        squares.append((density.rate + (velocity * density.slope).sum(1)).square().mean())
    return float(torch.stack(squares).mean().sqrt())


def test_what_splines_leave_falls_with_the_cube_of_their_cells():
    """The slope of a cubic spline errs by h³; 17 times of quartic splines err by less."""
    coarse, fine = (left_by(splines(cell, 17, 4)) for cell in (3.0, 1.5))
    assert 2.5 < math.log2(coarse / fine) < 4.5


def test_what_splines_of_time_leave_falls_with_the_square_of_the_step():
    """The rate of a quadratic spline errs by h²."""
    coarse, fine = (left_by(splines(1.5, times, 2)) for times in (4, 7))
    assert 1.7 < math.log2(coarse / fine) < 2.8


def model(solenoidal: bool) -> Model:
    """Of the turning lump, in a field that hardly flows."""
    grid, when = Grid.centred((7, 9, 11), PITCH), np.array([0.0, 1e-3, 3e-3])
    how = SpaceTime(velocity=VelocityNetwork(solenoidal, hidden=5))
    torch.manual_seed(1)
    field = SpaceTimeField.still(torch.rand(3, *grid.shape), grid, when, ONE, how, seed=3)
    field = field.with_parameters({n: p + 0.3 * torch.randn_like(p) for n, p in field.parameters().items()})
    exposures = Exposures.of(Views.from_angles([0.0], (9, 11), PITCH), 20.0, 0.1).repeated(when)
    return Model(field, Instrument(exposures))


def term(weights: Equations, seed: int = 0) -> EquationTerm:
    return EquationTerm(weights, 2.0, 1.5e-3, torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("solenoidal", [True, False])
def test_gradients_of_the_terms_are_those_of_finite_differences(solenoidal):
    """Of matter and velocity, in float64."""
    made, how = model(solenoidal), Equations(points=50, momentum_points=20, viscosity=1e-6)
    made = made.with_parameters({n: p.double() for n, p in made.parameters().items()})

    def loss(at: Model) -> torch.Tensor:
        return torch.stack([p.value if p.weight is None else p.weight * p.value for p in term(how)(at, NOW)]).sum()

    leaves = {n: p.clone().requires_grad_() for n, p in made.parameters().items()}
    loss(made.with_parameters(leaves)).backward()
    for name in ("object.coefficients", "object.flow.weight0", "object.flow.weight2"):
        way = torch.randn_like(leaves[name])
        ends = [loss(made.with_parameters({name: leaves[name].detach() + s * 1e-5 * way})) for s in (1, -1)]
        gradient = leaves[name].grad
        assert gradient is not None
        assert float((gradient * way).sum()) == pytest.approx(float(ends[0] - ends[1]) / 2e-5, rel=1e-4, abs=0)


def test_terms_are_integrals_over_the_field_in_voxel_edges_and_steps():
    """Matter at half occupancy that grows by 0.0025 a step, in a flow that stands still."""
    made = model(False)
    field = made.object
    assert isinstance(field, SpaceTimeField)
    still = {n: torch.zeros_like(p) for n, p in field.parameters().items()}
    still["coefficients"] += torch.tensor([-0.01, 0.0, 0.01])[:, None, None, None]
    found = made.with_parameters({f"object.{n}": p for n, p in still.items()})
    parts = {p.name: p for p in term(Equations(continuity=1.0, momentum=0.0))(found, NOW)}
    assert set(parts) == {"continuity", "divergence"}
    assert float(parts["divergence"].value) == 0
    assert parts["continuity"].weight == 0.5  # of two frames a time
    assert float(parts["continuity"].value) == pytest.approx(7 * 9 * 11 * 0.0025**2, rel=1e-3, abs=0)


def test_a_curl_has_no_part_of_divergence():
    assert [p.name for p in term(Equations())(model(True), NOW)] == ["continuity", "momentum"]


def test_variation_is_that_of_one_of_the_times():
    made = model(True)
    found = {
        round(
            float(
                SpaceTimeVariation(1.0, 0.005, [0.0, 1e-3, 3e-3], torch.Generator().manual_seed(k))(made, NOW)[0].value
            ),
            3,
        )
        for k in range(12)
    }
    assert len(found) == 3
