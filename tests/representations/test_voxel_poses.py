"""Voxels and neural fields in poses that are tensors: what they cast, and gradients of rotations and shifts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from helpers.poses import asking, gradients, relative
from helpers.voxels import pronounced, twin
from holosplat.geometry import Grid, Poses, Views
from holosplat.matter import Matter
from holosplat.representations import VoxelGrid, VoxelLines
from holosplat_bench.opponents.fields import Encoding, Network, NeuralField

PIXEL = 2e-6


def about_axis(count: int = 3, shape: tuple[int, int] = (21, 27)) -> Views:
    views = Views.from_angles(np.arange(count) * 37.0 + 5, shape, PIXEL)
    return replace(views, shifts=np.tile([1.3 * PIXEL, 0.4 * PIXEL], (count, 1)))


def any_pose(count: int = 3, shape: tuple[int, int] = (21, 27)) -> Views:
    shifts = np.random.default_rng(1).uniform(-1, 1, (count, 2)) * PIXEL
    return Views(Rotation.random(count, rng=3).as_matrix(), shifts, shape, PIXEL)


POSES = {"axis": about_axis, "any": any_pose}


def numbers(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


GRIDS = {
    "cubes": (Grid.centred((9, 11, 7), PIXEL), (1, 1, 1)),
    "uneven": (Grid((5, 9, 7), (PIXEL, 0.8 * PIXEL, 1.7 * PIXEL), (-3 * PIXEL, -3.3 * PIXEL, -3.1 * PIXEL)), (1, 1, 2)),
}


@pytest.mark.parametrize("views", POSES)
@pytest.mark.parametrize("grid", GRIDS)
def test_values_and_poses_have_the_gradients_of_the_twin(views, grid):
    (grid, factors), views = GRIDS[grid], POSES[views]()
    images, poses, expected = numbers(3, 2, *views.shape, seed=1), asking(views), asking(views)
    values, exact = numbers(2, *grid.shape).float().requires_grad_(), numbers(2, *grid.shape).requires_grad_()
    lines, wanted = VoxelLines(grid, poses)(values), twin(exact, grid, expected, factors)
    assert relative(lines, wanted) < 1e-5
    (lines * images).sum().backward()
    (wanted * images).sum().backward()
    assert values.grad is not None
    assert exact.grad is not None
    assert relative(values.grad, exact.grad) < 1e-5
    assert all(relative(a, b) < 1e-5 for a, b in zip(gradients(poses), gradients(expected)))


@pytest.mark.parametrize("views", POSES)
def test_known_poses_cast_what_views_cast(views):
    grid, views = Grid.centred((9, 11, 7), PIXEL), POSES[views]()
    voxels = VoxelGrid(numbers(2, *grid.shape).float(), grid, Matter.free(2.0, 0.5))
    as_views, as_poses = voxels.project(views), voxels.project(Poses.of(views))
    assert torch.equal(as_views.channels, as_poses.channels)
    unknown = voxels.project(asking(views)).channels
    assert unknown.requires_grad
    if views.shares_axis:  # strips there, hats here
        assert 0 < relative(unknown, as_views.channels) < 0.1
    else:
        assert torch.equal(unknown, as_views.channels)


def test_a_moving_ball_is_predicted_in_metres():
    """The images of a smooth ball that was turned or shifted, by the gradients of those of one that was not."""
    grid, views = Grid.centred((25, 23, 21), PIXEL), any_pose(3, (35, 38))
    x, y, z = (torch.from_numpy(axis / PIXEL) for axis in grid.axes())
    values = torch.exp(-((z[:, None, None] - 2) ** 2 + (y[:, None] + 1.5) ** 2 + (x - 1) ** 2) / 8)[None].float()
    voxels = VoxelGrid(values, grid, Matter.one(2.0, 0.5))
    weight = torch.sin(0.2 * torch.arange(38.0) + 0.3) * torch.cos(0.3 * torch.arange(35.0)[:, None])
    turn, shift = Rotation.from_rotvec([0.06, -0.04, 0.05]).as_matrix(), 0.5 * PIXEL * np.array([1.0, -0.7])
    poses = asking(views)
    (voxels.project(poses)[1] * weight).sum().backward()
    ends = (views.rotations @ turn - views.rotations @ turn.T, 2 * np.broadcast_to(shift, (3, 2)))
    found = sum(float((g * torch.tensor(e)).sum()) for g, e in zip(gradients(poses), ends))
    moved = [
        Views(views.rotations @ r, views.shifts + s * shift, views.shape, PIXEL) for r, s in ((turn, 1), (turn.T, -1))
    ]
    ahead, back = (float((voxels.project(at)[1] * weight).sum()) for at in moved)
    assert found == pytest.approx(ahead - back, rel=0.02)


# --- neural fields ------------------------------------------------------------------------------------------


def field(encoding: Encoding) -> NeuralField:
    """A field with some structure, in float64."""
    grid = Grid.centred((7, 5, 9), PIXEL)
    everywhere = torch.ones(grid.shape, dtype=torch.bool)
    return pronounced(NeuralField(grid, Matter.one(1.0, 0.1), Network(encoding, 8, 1), everywhere, seed=1))


ENCODINGS = {
    "dense": Encoding(levels=2, features=2, coarsest=8.0, finest=3.0, log2_size=12),
    "hashed": Encoding(levels=2, features=2, coarsest=8.0, finest=3.0, log2_size=4),
    "fourier": Encoding("fourier", waves=4, bandwidth=0.05),
}


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_a_neural_field_has_the_finite_differences_of_poses(encoding):
    made, views = field(ENCODINGS[encoding]), any_pose(2, (5, 7))
    poses, weight = asking(views), numbers(2, 1, 5, 7, seed=4)
    (made.project(poses).channels / PIXEL * weight).sum().backward()

    def value(step: float) -> float:
        ends = [a.detach() + step * b for a, b in zip((poses.rotations, poses.shifts), way)]
        moved = replace(poses, rotations=ends[0], shifts=ends[1])
        with torch.no_grad():
            return float((made.project(moved).channels / PIXEL * weight).sum())

    for seed in range(3):
        way = (numbers(2, 3, 3, seed=seed) - 0.5, (numbers(2, 2, seed=seed + 9) - 0.5) * PIXEL)
        found = sum(float((a * b).sum()) for a, b in zip(gradients(poses), way))
        assert found == pytest.approx((value(1e-6) - value(-1e-6)) / 2e-6, rel=1e-4)


def test_a_neural_field_casts_the_same_in_poses_and_views():
    made, views = field(ENCODINGS["dense"]), any_pose(2, (5, 7)).refined(2)
    with torch.no_grad():
        assert torch.equal(made.project(views).channels, made.project(Poses.of(views)).channels)
