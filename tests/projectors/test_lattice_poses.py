"""Gradients of poses of the lattice projector: against its float64 twin, finite differences and closed forms."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from helpers.poses import asking, gradients, relative
from helpers.voxels import anyhow, around, randoms
from holosplat.checks import InputError
from holosplat.geometry import Grid, Poses, Views
from holosplat.projectors.voxels import LatticeProjector
from holosplat.projectors.voxels.lattice import lattice_reference

UNEVEN = Grid((11, 7, 9), (1.1, 0.8, 0.9), (-4.0, -2.9, -3.7))
ALIGNED = Grid((8, 6, 10), (1.0, 1.0, 1.0), (-4.5, -2.5, -3.5))
"""Its rows are rows of pixels of a raster (10, 13), whatever the angle about y; at 0° its columns are columns."""


def scaled(grid: Grid, views: Views, metre: float) -> tuple[Grid, Views]:
    size, origin = (tuple(metre * a for a in ends) for ends in (grid.voxel_size, grid.origin))
    return Grid(grid.shape, size, origin), Views(views.rotations, views.shifts * metre, views.shape, metre)


CASES = [
    (UNEVEN, anyhow(5, (17, 18))),
    (UNEVEN, anyhow(4, (6, 5), seed=1)),  # partly beyond the detector
    (UNEVEN, around(4, (15, 12), 0.3)),
    (ALIGNED, around(5, (10, 13))),
]


@pytest.mark.parametrize(("grid", "views"), CASES, ids=["any", "narrow", "axis", "aligned"])
@pytest.mark.parametrize("metre", [1.0, 2.5e-7])
@pytest.mark.parametrize("threads", [1, 3])
def test_the_compiled_gradients_are_those_of_the_float64_twin(grid, views, metre, threads):
    grid, views = scaled(grid, views, metre)
    image = randoms(len(views), *views.shape, seed=1)
    twin, volume = asking(views), randoms(*grid.shape).requires_grad_()
    (lattice_reference(volume, grid, twin) * image).sum().backward()
    poses, values = asking(views), volume.detach().float().requires_grad_()
    torch.set_num_threads(threads)
    (LatticeProjector(grid, poses).lines(values) * image.float()).sum().backward()
    torch.set_num_threads(1)
    assert values.grad is not None
    assert volume.grad is not None
    assert relative(values.grad, volume.grad) < 1e-5
    for found, wanted in zip(gradients(poses), gradients(twin)):
        assert float(wanted.abs().max()) > 0.1 * metre
        assert relative(found, wanted) < 1e-5
    assert not gradients(poses)[0][:, 2].any()


def test_any_number_of_threads_gives_the_same_bits():
    views, found = anyhow(3, (17, 18)), []
    for threads in (1, 2, 5):
        torch.set_num_threads(threads)
        poses = asking(views)
        lines = LatticeProjector(UNEVEN, poses).lines(randoms(*UNEVEN.shape).float())
        (lines * randoms(*lines.shape, seed=1).float()).sum().backward()
        found.append(gradients(poses))
    torch.set_num_threads(1)
    assert all(torch.equal(a, b) for other in found[1:] for a, b in zip(found[0], other))


def summed(grid: Grid, volume: Tensor, poses: Poses, image: Tensor) -> Tensor:
    return (lattice_reference(volume, grid, poses) * image).sum()


def along(poses: Poses, way: tuple[Tensor, Tensor], step: float) -> Poses:
    """Plain numbers a step away."""
    rotations, shifts = (a.detach() + step * b for a, b in zip((poses.rotations, poses.shifts), way))
    return replace(poses, rotations=rotations, shifts=shifts)


@pytest.mark.parametrize("case", ["any", "aligned"])
def test_the_twin_is_the_finite_difference(case):
    """Along random directions of all numbers; on pixels' centres too, where it is the mean of both sides."""
    grid, views = (UNEVEN, anyhow(3, (17, 18))) if case == "any" else (ALIGNED, around(3, (10, 13)))
    volume, image, poses = randoms(*grid.shape), randoms(len(views), *views.shape, seed=1), asking(views)
    if case == "aligned":  # what lies on the rim may leave
        volume[:, [0, -1]], volume[:, :, [0, -1]] = 0, 0
    summed(grid, volume, poses, image).backward()
    for seed in range(4):
        way = randoms(*poses.rotations.shape, seed=seed), randoms(*poses.shifts.shape, seed=seed + 10)
        step = 1e-7
        ahead, back = (summed(grid, volume, along(poses, way, s * step), image) for s in (1, -1))
        found = sum(float((a * b).sum()) for a, b in zip(gradients(poses), way))
        assert found == pytest.approx(float(ahead - back) / (2 * step), rel=1e-5)


def blob(grid: Grid, centre: Tensor, width: float) -> Tensor:
    """A Gaussian of peak 1 and standard deviation `width` on the grid."""
    x, y, z = (torch.from_numpy(axis) - c for axis, c in zip(grid.axes(), centre))
    return torch.exp(-0.5 * (z[:, None, None] ** 2 + y[:, None] ** 2 + x**2) / width**2)


def weighted_chords(poses: Poses, centre: Tensor, width: float, image: Tensor) -> Tensor:
    """Σ image × the blob's line integrals, in closed form; for any matrix A of two rows its covariance is σ² A Aᵀ."""
    (h, w), p, across = poses.shape, poses.pitch, poses.rotations[:, :2]
    at = across @ centre - poses.shifts
    x = ((torch.arange(w).double() + 0.5 - 0.5 * w) * p - at[:, 0, None, None]).expand(-1, h, -1)
    y = (((torch.arange(h).double() + 0.5 - 0.5 * h) * p)[:, None] - at[:, 1, None, None]).expand(-1, -1, w)
    covariance = width**2 * across @ across.mT
    power = torch.einsum("viyx,vij,vjyx->vyx", torch.stack((x, y), 1), covariance.inverse(), torch.stack((x, y), 1))
    peak = (2 * torch.pi) ** 0.5 * width**3 / covariance.det().sqrt()
    return (image * peak[:, None, None] * torch.exp(-0.5 * power)).sum()


def test_gradients_of_a_moving_blob_converge_to_the_closed_form():
    """By the second order in the voxel, which is the pixel: what a turn and a shift do to a weighted sum of images."""
    centre, width, views = torch.tensor([2.0, -1.5, 1.2]).double(), 1.3, anyhow(4, (23, 26))
    gaps = []
    for n in (1, 2, 4):
        fine, grid = views.refined(n), Grid.centred((19, 21, 20), 1.0).divided((n, n, n))
        (h, w), p = fine.shape, fine.pixel_size
        x, y = ((torch.arange(m).double() + 0.5 - 0.5 * m) * p for m in (w, h))
        image = (1 + torch.sin(0.5 * x + 0.3) * torch.cos(0.4 * y[:, None] - 0.2)) * p**2
        poses, exact = asking(fine), asking(fine)
        lines = LatticeProjector(grid, poses).lines(blob(grid, centre, width).float())
        (lines * image).sum().backward()
        weighted_chords(exact, centre, width, image).backward()
        gaps.append(tuple(relative(f[:, :2], e[:, :2]) for f, e in zip(gradients(poses), gradients(exact))))
    for coarse, middle, fine in zip(*gaps):
        assert coarse < 0.05
        assert middle < coarse / 3
        assert fine < middle / 3


def test_the_compiled_gradient_predicts_a_small_motion():
    """What is left of the change of the image, after gradient times step, is of second order in the step."""
    grid, views = Grid.centred((19, 21, 20), 1.0), anyhow(3, (23, 26))
    volume = blob(grid, torch.tensor([1.0, -1.5, 0.7]), 2.5)
    x, y = torch.arange(26).double() - 12, torch.arange(23).double() - 11
    image = torch.sin(0.3 * x + 0.3) * torch.cos(0.2 * y[:, None] - 0.2)
    poses, way = asking(views), (0.05 * randoms(3, 3, 3, seed=2), randoms(3, 2, seed=3))
    (LatticeProjector(grid, poses).lines(volume.float()) * image).sum().backward()
    slope = sum(float((a * b).sum()) for a, b in zip(gradients(poses), way))
    at_rest = float(summed(grid, volume, along(poses, way, 0.0), image))
    left = [
        abs(float(summed(grid, volume, along(poses, way, t), image)) - at_rest - t * slope) for t in (0.4, 0.2, 0.1)
    ]
    assert left[0] < 0.3 * abs(0.4 * slope)
    assert left[1] < left[0] / 3
    assert left[2] < left[1] / 3


def test_known_poses_cost_nothing_and_change_nothing(monkeypatch):
    views, volume = anyhow(3, (17, 18)), randoms(*UNEVEN.shape).float()
    plain = LatticeProjector(UNEVEN, views).project(volume)
    asked = LatticeProjector(UNEVEN, asking(views)).lines(volume)
    assert torch.equal(plain, asked)
    monkeypatch.setattr(LatticeProjector, "pose_gradients", None)
    leaf = volume.clone().requires_grad_()
    LatticeProjector(UNEVEN, Poses.of(views)).lines(leaf).sum().backward()
    assert leaf.grad is not None
    with pytest.raises(TypeError):
        asked.sum().backward()


def test_both_backends_give_gradients_of_poses():
    views, volume = anyhow(2, (17, 18)), randoms(*UNEVEN.shape).float()
    found = []
    for backend in ("cpu", "reference"):
        poses = asking(views)
        LatticeProjector(UNEVEN, poses, backend).lines(volume).square().sum().backward()
        found.append(gradients(poses))
    assert all(relative(a, b) < 1e-4 for a, b in zip(*found))


def test_poses_of_another_kind_are_refused():
    poses = Poses.of(anyhow(2, (5, 7)))
    for wrong in (replace(poses, shifts=poses.shifts.float()), replace(poses, shifts=poses.shifts[:1])):
        with pytest.raises(InputError, match="poses of voxels must be float64 tensors"):
            LatticeProjector(UNEVEN, wrong)
