"""Voxels of several times: each time, low rank, six planes, and canonical voxels that a network displaces."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from holosplat.checks import InputError
from holosplat.geometry import Grid, Views
from holosplat.matter import Matter
from holosplat_bench.opponents.moving.deformed_voxels import NETWORK, Deformation, DeformedVoxels
from holosplat_bench.opponents.moving.hexplane_field import PAIRS, TIME_PLANES, HexPlaneField, HexPlanes, hats
from holosplat_bench.opponents.moving.moving_voxels import LowRankVoxels, OnVoxels, VoxelSeries, held, shares

PITCH = 2e-6
GRID = Grid((5, 7, 4), (PITCH, PITCH, PITCH), (-3e-6, -6e-6, -4e-6))
"""Rectangular, odd and even."""
ONE, TIMES = Matter.one(3e-7, 2e-10), np.array([1e-3, 2e-3, 4e-3, 5e-3])
SMALL = Deformation(layers=2, hidden=6, place_frequencies=2, time_frequencies=1, cell_px=2.0, beyond_px=3.0)
PLANES = HexPlanes(features=3, hidden=5, cell_px=1.5, time_nodes=3)


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def a_series() -> VoxelSeries:
    return VoxelSeries(random(4, *GRID.shape).float(), GRID, TIMES, ONE, 1.0)


def planes(upper: float = 1.0, options: HexPlanes = PLANES) -> HexPlaneField:
    """In float64, with features of any size."""
    weights = {n: random(*s, seed=k) - 0.4 for k, (n, s) in enumerate(options.shapes(GRID, len(TIMES)).items())}
    return HexPlaneField(weights, GRID, TIMES, ONE, upper, options)


def deformed(moves: float = 0.3) -> DeformedVoxels:
    """In float64, with a network that moves."""
    found = DeformedVoxels.still(random(*GRID.shape).float(), GRID, TIMES, ONE, 0.0, SMALL, seed=1)
    own = found.parameters()
    change = {n: p.double() + moves * (random(*p.shape, seed=7) - 0.5) for n, p in own.items() if n != "canonical"}
    return found.with_parameters({"canonical": own["canonical"].double(), **change})


def above_zero() -> DeformedVoxels:
    """The same with matter beyond the field, too: at zero the slope of what is held is one-sided."""
    found = deformed()
    return found.with_parameters({"canonical": random(*found.canonical.shape, seed=4) + 0.1})


def low_rank() -> LowRankVoxels:
    return LowRankVoxels((random(2, *GRID.shape) + 0.1, random(2, 4, seed=1) + 0.1), GRID, TIMES, ONE)


def test_a_series_is_linear_between_its_times_and_held_beyond():
    series = a_series()
    assert torch.equal(series.values(2e-3), series.volumes[1])
    torch.testing.assert_close(series.values(2.5e-3), 0.75 * series.volumes[1] + 0.25 * series.volumes[2])
    assert torch.equal(series.values(9.0), series.volumes[3])
    assert torch.equal(series.at(1e-3).values[0], series.volumes[0])
    np.testing.assert_allclose(shares(TIMES, 3e-3), [0, 0.5, 0.5, 0])


def test_low_rank_of_as_many_volumes_as_times_is_the_series_itself():
    series = a_series()
    found = LowRankVoxels.nearest(series, 9)
    assert len(found.courses) == 4
    for time in (*TIMES, 3e-3):
        torch.testing.assert_close(found.values(time), series.values(time), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("rank", [1, 2, 3])
def test_low_rank_is_what_a_singular_value_decomposition_leaves(rank):
    """By numpy's own, which shares nothing with it; before what is below zero is held there."""
    series = a_series()
    found = LowRankVoxels.nearest(series, rank)
    u, s, v = np.linalg.svd(series.volumes.reshape(4, -1).numpy(), full_matrices=False)
    wanted = (u[:, :rank] * s[:rank]) @ v[:rank]
    ours = (found.courses.T @ found.volumes.reshape(rank, -1)).numpy()
    np.testing.assert_allclose(ours, wanted, atol=1e-5)
    np.testing.assert_allclose(found.courses.square().mean(1), 1.0, rtol=1e-5)


@pytest.mark.parametrize(("value", "slope"), [(-0.1, 1.0), (-0.1, -1.0), (0.5, 1.0), (1.2, -1.0), (1.2, 1.0)])
def test_what_is_held_comes_back_and_goes_no_further(value, slope):
    leaf = torch.tensor([value], requires_grad=True)
    found = held(leaf, 1.0)
    found.backward(torch.tensor([slope]))
    assert 0 <= float(found.detach()) <= 1
    outwards = (value < 0 and slope > 0) or (value > 1 and slope < 0)
    assert leaf.grad is not None
    assert float(leaf.grad) == (0.0 if outwards else slope)
    assert float(held(torch.tensor([7.0]), 0.0)) == 7.0


def directly(field: HexPlaneField, time: float) -> Tensor:
    """The formula of the field, feature by feature, at every voxel."""
    own, options = field.parameters(), field.options
    axes = {axis: hats(n, options.nodes(n)).double() for axis, n in zip("zyx", GRID.shape)}
    nodes = np.linspace(TIMES[0], TIMES[-1], 3)
    axes["t"] = torch.from_numpy(shares(nodes, time))[None]

    def feature(plane: str) -> Tensor:
        """[F, Z, Y, X], of one voxel along an axis that the plane does not have."""
        second, first = plane
        flat = torch.einsum("fab,ma,nb->fmn", own[plane], axes[first], axes[second])
        if first == "t":
            return flat[:, 0].reshape(3, *[-1 if axis == second else 1 for axis in "zyx"])
        missing = next(k for k, axis in enumerate("zyx") if axis not in plane)
        return flat.unsqueeze(missing + 1)

    layers = [torch.einsum("hf,fzyx->hzyx", own[f"mix_{a}"], feature(a) * feature(b)) for a, b in PAIRS]
    hidden = torch.relu(sum(layers, own["bias"][:, None, None, None]))
    raw = torch.einsum("h,hzyx->zyx", own["out"], hidden) + own["out_bias"]
    return field.upper * torch.sigmoid(raw) if field.upper else torch.nn.functional.softplus(raw)


@pytest.mark.parametrize("upper", [0.0, 0.8])
def test_six_planes_are_their_formula(upper):
    field = planes(upper)
    for time in (1e-3, 2.7e-3):
        torch.testing.assert_close(field.values(time), directly(field, time))


def test_planes_that_ignore_time_are_the_same_at_all_times():
    field = planes()
    own = field.parameters()
    still = field.with_parameters({n: own[n][:, :1].expand_as(own[n]) for n in TIME_PLANES})
    torch.testing.assert_close(still.values(1e-3), still.values(4.1e-3))
    assert float((field.values(1e-3) - field.values(4.1e-3)).abs().max()) > 1e-3


@pytest.mark.parametrize("upper", [0.0, 1.0])
def test_planes_begin_nearly_empty_and_still(upper):
    found = HexPlaneField(PLANES.started(GRID, 4, upper, 3), GRID, TIMES, ONE, upper, PLANES)
    assert 0 < float(found.values(1e-3).mean()) < 0.2
    torch.testing.assert_close(found.values(1e-3), found.values(5e-3))
    again = PLANES.started(GRID, 4, upper, 3)
    assert all(torch.equal(again[n], p) for n, p in found.parameters().items())


def test_no_deformation_gives_the_canonical_matter():
    values = random(*GRID.shape).float()
    found = DeformedVoxels.still(values, GRID, TIMES, ONE, 1.0, SMALL)
    for time in TIMES:
        torch.testing.assert_close(found.values(time), values, rtol=1e-4, atol=1e-5)
    moving = deformed()
    middle = 0.5 * (TIMES[0] + TIMES[-1])
    torch.testing.assert_close(moving.values(middle), values.double(), rtol=1e-6, atol=1e-6)


def test_a_uniform_displacement_shifts_by_whole_voxels():
    """By (1, -2, 0) voxels from the middle of the times to their end, and by as much back at their beginning."""
    values = random(*GRID.shape).float()
    found = DeformedVoxels.still(values, GRID, TIMES, ONE, 0.0, SMALL)
    out = torch.tensor([1.0, -2.0, 0.0]) / SMALL.reach_px
    found = found.with_parameters({f"{NETWORK}bias2": out})
    late, early = found.values(5e-3), found.values(1e-3)
    torch.testing.assert_close(late[:, 2:, :-1], values[:, :-2, 1:], rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(early[:, :-2, 1:], values[:, 2:, :-1], rtol=1e-3, atol=1e-4)
    assert float(late[:, 0].abs().max()) < 1e-4  # from beyond the field, where nothing is


@pytest.mark.parametrize("make", [low_rank, planes, above_zero])
def test_gradients_are_those_of_differences(make):
    obj: OnVoxels = make()
    names = list(obj.parameters())
    leaves = [p.detach().clone().requires_grad_() for p in obj.parameters().values()]
    wanted = random(*GRID.shape, seed=5)

    def loss(*given: Tensor) -> Tensor:
        return (wanted * obj.with_parameters(dict(zip(names, given))).values(1.7e-3)).sum()

    assert torch.autograd.gradcheck(loss, leaves, eps=1e-7, atol=1e-4, fast_mode=True)


@pytest.mark.parametrize("make", [a_series, low_rank, planes, deformed])
def test_they_are_objects(make):
    obj = make()
    assert obj.kind in type(obj).kind
    again = type(obj).from_state(obj.state())
    assert torch.equal(again.values(2.2e-3), obj.values(2.2e-3))
    assert again.described == obj.described
    assert obj.enclosing_grid(5) == GRID
    assert obj.on("cpu").backend == "cpu"
    assert (obj.basis.first, obj.basis.last) == (1e-3, 5e-3)
    views = Views.from_angles([0.0, 40.0], (7, 6), PITCH)
    assert tuple(obj.at(2e-3).project(views).channels.shape) == (2, 1, 7, 6)
    assert obj.project(views).channels.isfinite().all()
    assert np.array_equal(obj.voxelise(GRID).delta, obj.at(1e-3).voxelise(GRID).delta)


def test_what_does_not_fit_is_refused():
    volumes = random(4, *GRID.shape)
    with pytest.raises(InputError, match=r"volumes of a voxel series must have the shape \(4, 5, 7, 4\)"):
        VoxelSeries(volumes[:3], GRID, TIMES, ONE)
    with pytest.raises(InputError, match="times must be two or more, and must grow"):
        VoxelSeries(volumes, GRID, TIMES[::-1], ONE)
    with pytest.raises(InputError, match="need one material"):
        VoxelSeries(volumes, GRID, TIMES, ONE.freed())
    with pytest.raises(InputError, match="upper must not be negative"):
        VoxelSeries(volumes, GRID, TIMES, ONE, -1.0)
    with pytest.raises(InputError, match="courses of voxels of low rank must have the shape"):
        LowRankVoxels((volumes[:2], random(3, 4)), GRID, TIMES, ONE)
    with pytest.raises(InputError, match="one volume at least"):
        LowRankVoxels((volumes[:0], random(0, 4)), GRID, TIMES, ONE)
    with pytest.raises(InputError, match="xy of a hexplane field must have the shape"):
        HexPlaneField(planes().parameters(), GRID, TIMES, ONE, 1.0, replace(PLANES, cell_px=1.0))
    with pytest.raises(InputError, match="canonical of deformed voxels must have the shape"):
        DeformedVoxels((volumes[0], SMALL.started(0)), GRID, TIMES, ONE, 1.0, SMALL)
    for options in ({"cell_px": 0.0}, {"reach_px": 0.0}, {"layers": 0}):
        with pytest.raises(InputError):
            Deformation(**options)  # pyright: ignore[reportArgumentType]
    for options in ({"empty": 0.0}, {"empty": 1.0}, {"features": 0}):
        with pytest.raises(InputError):
            HexPlanes(**options)  # pyright: ignore[reportArgumentType]
