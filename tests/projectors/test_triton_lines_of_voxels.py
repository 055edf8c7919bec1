"""The GPU's line integrals of voxels against their float64 twins: on a GPU, or in Triton's interpreter."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from helpers.poses import asking, gradients, relative
from helpers.voxels import ROWS, anyhow, around, randoms
from holosplat.checks import InputError
from holosplat.geometry import Grid, Poses
from holosplat.projectors.voxels import LatticeProjector, SliceProjector, projector_for
from holosplat.projectors.voxels.lattice import lattice_reference
from holosplat.projectors.voxels.slices import voxel_shadows

UNEVEN = Grid((11, 7, 9), (1.1, 0.8, 0.9), (-4.0, -2.9, -3.7))
ALIGNED = Grid((8, 6, 10), (1.0, 1.0, 1.0), (-4.5, -2.5, -3.5))
"""Its rows are rows of pixels of a raster (10, 13), whatever the angle about y; at 0° its columns are columns."""

CASES = {
    "any": (UNEVEN, anyhow(3, (17, 18))),
    "narrow": (UNEVEN, anyhow(4, (6, 5), seed=1)),  # partly beyond the detector
    "aligned": (ALIGNED, around(3, (10, 13))),
    "at the rim": (ALIGNED, around(3, (6, 10))),  # at 0° the outermost voxels lie on the outermost pixels' centres
    "of several sizes": (UNEVEN, replace(anyhow(3, (13, 16)), scales=np.array([1, 1.25, 0.8]))),
}
cases = pytest.mark.parametrize(("grid", "views"), CASES.values(), ids=CASES)


def on(gpu: torch.device, poses: Poses) -> Poses:
    """The same poses there, asking for gradients of their own."""
    rotations, shifts = (a.detach().to(gpu).requires_grad_() for a in (poses.rotations, poses.shifts))
    scales = None if poses.scales is None else poses.scales.to(gpu)
    return replace(poses, rotations=rotations, shifts=shifts, scales=scales)


def assert_adjoint(projector: LatticeProjector | SliceProjector, gpu: torch.device) -> None:
    """<Ax, y> = <x, Aᵀy>, and Aᵀ on single pixels, too."""
    x = randoms(*projector.array_shape, seed=2).float().to(gpu)
    lines = projector.project(x)
    y = randoms(*lines.shape, seed=3).float().to(gpu)
    forward = float((lines.double() * y.double()).sum())
    assert abs(forward) > 1
    assert forward == pytest.approx(float((x.double() * projector.backproject(y).double()).sum()), rel=1e-5)
    unit = torch.zeros_like(lines)
    at = tuple(n // 2 for n in lines.shape)
    unit[at] = 1
    assert float((projector.backproject(unit) * x).sum()) == pytest.approx(float(lines[at]), abs=1e-5)


# --- any pose -----------------------------------------------------------------------------------------------


@cases
@pytest.mark.parametrize("metre", [1.0, 2.5e-7])
def test_the_lattice_and_its_gradients_are_those_of_the_float64_twin(gpu, grid, views, metre):
    size, origin = (tuple(metre * a for a in ends) for ends in (grid.voxel_size, grid.origin))
    grid, views = Grid(grid.shape, size, origin), replace(views, shifts=views.shifts * metre, pitch=metre)
    volume, image = randoms(*grid.shape), randoms(len(views), *views.shape, seed=1)
    volume[3:5, 1:] = 0
    twin, leaf = asking(views), volume.clone().requires_grad_()
    wanted = lattice_reference(leaf, grid, twin)
    (wanted * image).sum().backward()
    poses, values = on(gpu, asking(views)), volume.float().to(gpu).requires_grad_()
    lines = LatticeProjector(grid, poses, "cuda").lines(values)
    (lines * image.float().to(gpu)).sum().backward()
    assert values.grad is not None
    assert leaf.grad is not None
    lines, wanted = lines.detach().cpu(), wanted.detach()
    assert float((lines - wanted).abs().max() / wanted.abs().max()) < 2e-6
    assert relative(values.grad.cpu(), leaf.grad) < 1e-6
    for found, truth in zip(gradients(poses), gradients(twin)):
        assert found.dtype == torch.float64
        assert relative(found.cpu(), truth) < 1e-6
    assert not gradients(poses)[0][:, 2].any()


@pytest.mark.parametrize("name", ["any", "aligned"])
def test_gradients_of_poses_are_those_of_the_compiled_kernel(gpu, name, monkeypatch):
    """Where a program takes several blocks of voxels, too."""
    from holosplat.projectors.voxels.lattice_kernels import triton_lattice

    grid, views = CASES[name]
    volume, image = randoms(*grid.shape).float(), randoms(len(views), *views.shape, seed=1).float()
    wanted = LatticeProjector(grid, views).pose_gradients(volume, image)
    for programs in (triton_lattice.POSE_PROGRAMS, 2):
        monkeypatch.setattr(triton_lattice, "POSE_PROGRAMS", programs)
        found = LatticeProjector(grid, views, "cuda").pose_gradients(volume.to(gpu), image.to(gpu))
        assert all(relative(a.cpu(), b) < 1e-10 for a, b in zip(found, wanted))


@cases
def test_the_lattice_has_an_exact_adjoint(gpu, grid, views):
    assert_adjoint(LatticeProjector(grid, views, "cuda"), gpu)


@pytest.mark.parametrize("shape", [(1, 9), (9, 1)])
def test_a_raster_of_one_row_or_column_sees_nothing(gpu, shape):
    views = anyhow(2, shape)
    volume, images = torch.ones(UNEVEN.shape, device=gpu), torch.ones(2, *shape, device=gpu)
    projector = LatticeProjector(UNEVEN, views, "cuda")
    found = (projector.project(volume), projector.backproject(images), *projector.pose_gradients(volume, images))
    assert [tuple(a.shape) for a in found] == [(2, *shape), UNEVEN.shape, (2, 3, 3), (2, 2)]
    assert not any(a.any() for a in found)


def test_arrays_elsewhere_are_refused(gpu):
    projector = LatticeProjector(UNEVEN, anyhow(2, (13, 16)), "cuda")
    with pytest.raises(InputError, match="the volume must be on the device"):
        projector.project(torch.ones(UNEVEN.shape, device="meta"))
    with pytest.raises(InputError, match="the line integrals must be on the device"):
        projector.backproject(torch.ones(2, 13, 16, device="meta"))
    poses = Poses.of(anyhow(2, (13, 16)))
    wrong = replace(poses, rotations=poses.rotations.to("meta"), shifts=poses.shifts.to("meta"))
    with pytest.raises(InputError, match="poses of voxels must be float64 tensors on"):
        LatticeProjector(UNEVEN, wrong, "cuda")


# --- one axis -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("rows", "width"), [(1, 12), (7, 5), (131, 9)])
def test_slices_equal_their_float64_twin(gpu, rows, width):
    """A narrow detector, and more slices than a program takes."""
    grid = Grid((5, rows, 4), (1.1, 1.0, 0.9), (-1.7, 0.5 - 0.5 * rows, -1.7))
    views = around(3, (rows, width), 0.3)
    matrix = torch.from_numpy(voxel_shadows(grid, views).toarray().T).double()
    volume, lines = randoms(5, 4, rows), randoms(3, width, rows)
    projector = SliceProjector(grid, views, "cuda")
    found = (projector.project(volume.float().to(gpu)), projector.backproject(lines.float().to(gpu)))
    wanted = (matrix @ volume.reshape(20, rows), matrix.T @ lines.reshape(3 * width, rows))
    for array, truth, shape in zip(found, wanted, ((3, width, rows), (5, 4, rows))):
        assert tuple(array.shape) == shape
        assert array.device.type == gpu.type
        assert float((array.cpu() - truth.reshape(shape)).abs().max() / truth.abs().max()) < 1e-6


def test_slices_have_an_exact_adjoint(gpu):
    assert_adjoint(SliceProjector(ROWS, around(3, (7, 12), 0.3), "cuda"), gpu)


# --- both ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("grid", "views", "kind"),
    [(ROWS, around(2, (7, 12)), SliceProjector), (UNEVEN, anyhow(2, (13, 16)), LatticeProjector)],
)
def test_the_fastest_projector_that_fits_is_taken(gpu, grid, views, kind):
    projectors = [projector_for(grid, views, backend) for backend in ("cuda", "cpu")]
    assert all(type(projector) is kind for projector in projectors)
    volume = randoms(*grid.shape).float()

    def lines(projector: LatticeProjector | SliceProjector, array: Tensor) -> Tensor:
        return projector.lines_out(projector.project(projector.volume_in(array))).cpu()

    found, wanted = lines(projectors[0], volume.to(gpu)), lines(projectors[1], volume)
    assert relative(found, wanted) < 1e-6
