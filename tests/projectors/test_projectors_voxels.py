"""Voxel projectors against closed forms and each other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.nn.functional import avg_pool2d

from helpers.voxels import DOUBLE, ROWS, anyhow, around, randoms
from holosplat.checks import InputError
from holosplat.geometry import Grid, Views
from holosplat.projectors.splat import splat
from holosplat.projectors.voxels import (
    LatticeProjector,
    SliceProjector,
    projector_for,
    slices,
    voxel_line_integrals,
)
from holosplat.projectors.voxels.lattice import lattice_reference
from holosplat.projectors.voxels.slices import voxel_shadows

UNEVEN = Grid((11, 7, 9), (1.1, 0.8, 0.9), (-4.0, -2.9, -3.7))
CUBES = Grid((11, 7, 9), (1.0, 1.0, 1.0), (-4.0, -3.0, -4.7))
"""Such rows and cubic voxels at once."""
CUBIC = Grid((11, 7, 9), (0.9, 0.9, 0.9), (-4.0, -2.9, -3.7))
"""Cubic voxels only."""


def slices_of(volume: Tensor, grid: Grid, views: Views) -> Tensor:
    """Line integrals [V, H, W] by slice matrices, in float64 but for the matrix."""
    projector = SliceProjector(grid, views)
    return projector.lines_out(projector.project(projector.volume_in(volume.float()))).double()


# --- adjoints -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "projector",
    [
        SliceProjector(ROWS, around(5, (7, 12), 0.3)),
        SliceProjector(ROWS, around(2, (7, 5))),
        LatticeProjector(CUBIC, anyhow(3, (13, 16))),
        LatticeProjector(CUBIC, anyhow(4, (6, 5), seed=1)),
    ],
    ids=["slices, wide", "slices, narrow", "lattice, wide", "lattice, narrow"],
)
def test_compiled_projectors_have_an_exact_adjoint(projector):
    x = randoms(*projector.array_shape, dtype=torch.float32)
    lines = projector.project(x)
    y = randoms(*lines.shape, seed=1, dtype=torch.float32)
    forward = (lines.double() * y.double()).sum()
    backward = (x.double() * projector.backproject(y).double()).sum()
    assert abs(float(forward)) > 1
    assert float(forward) == pytest.approx(float(backward), rel=1e-5)
    # row by row of the matrix, not one sum of them
    unit = torch.eye(lines.numel()).reshape(-1, *lines.shape)[3::29]
    rows = torch.stack([projector.backproject(u) for u in unit])
    assert torch.allclose(rows.flatten(1) @ x.flatten(), (unit * lines).flatten(1).sum(1), atol=1e-5)


@pytest.mark.parametrize("views", [anyhow(5, (13, 16)), anyhow(5, (6, 5), seed=1), around(4, (7, 12), 0.3)])
@pytest.mark.parametrize("threads", [1, 2])
def test_the_lattice_equals_its_float64_twin(views, threads):
    """On grids in pixels and in metres; voxels at odd places, some of them beyond the detector."""
    volume, metre = randoms(*CUBIC.shape), 2.5e-7
    scaled = replace(views, pitch=metre, shifts=views.shifts * metre)
    grid = replace(CUBIC, voxel_size=(0.9 * metre,) * 3, origin=tuple(metre * o for o in CUBIC.origin))
    truth = lattice_reference(volume, CUBIC, views)
    torch.set_num_threads(threads)
    lines = [
        LatticeProjector(g, v).project(volume.float()) / u for g, v, u in ((CUBIC, views, 1), (grid, scaled, metre))
    ]
    torch.set_num_threads(1)
    for image in lines:
        assert float((image.double() - truth).abs().max() / truth.abs().max()) < 1e-5


@pytest.mark.parametrize("rows", [1, 7, 16, 37])
def test_slices_equal_their_float64_twin_for_any_number_of_threads(rows):
    """Fewer slices than a kernel takes at a time, as many, and more; with empty voxels, which are passed over."""
    grid, views = Grid((11, rows, 9), (1.1, 1.0, 0.9), (-4.0, 0.5 - 0.5 * rows, -4.7)), around(5, (rows, 12))
    matrix = torch.from_numpy(voxel_shadows(grid, views).toarray().T).double()
    volume, lines = randoms(11, 9, rows), randoms(5, 12, rows)
    volume[3:, 2:] = 0
    wanted = (matrix @ volume.reshape(99, rows), matrix.T @ lines.reshape(60, rows))
    for backend in ("cpu", "reference"):
        projector, found = SliceProjector(grid, views, backend), []
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            found.append((projector.project(volume.float()), projector.backproject(lines.float())))
        torch.set_num_threads(1)
        for array, truth in zip(found[0], wanted):
            assert float((array.double().reshape(truth.shape) - truth).abs().max() / truth.abs().max()) < 1e-6
        assert all(torch.equal(a, b) for other in found[1:] for a, b in zip(found[0], other))


def test_a_matrix_and_its_transpose_are_made_of_the_same_shadows(monkeypatch):
    """Of many views they take longer to make than some products with them."""
    made = []
    monkeypatch.setattr(slices, "voxel_shadows", lambda *given: made.append(given) or voxel_shadows(*given))
    monkeypatch.setattr(slices, "SMALL", 0)
    SliceProjector(CUBES, around(3, (7, 12)), "reference")
    assert len(made) == 1


@pytest.mark.parametrize("projector", [kind(CUBES, around(3, (7, 12))) for kind in (SliceProjector, LatticeProjector)])
def test_orders_of_arrays_go_there_and_back(projector):
    volume, images = randoms(*CUBES.shape), randoms(3, 7, 12)
    assert torch.equal(projector.volume_out(projector.volume_in(volume)), volume)
    assert torch.equal(projector.lines_out(projector.lines_in(images)), images)
    array = projector.volume_in(volume).float()
    assert tuple(array.shape) == projector.array_shape
    assert projector.lines_out(projector.project(array)).shape == (3, 7, 12)
    assert projector.backproject(projector.lines_in(images).float()).shape == projector.array_shape


def test_rays_are_differentiable_in_the_values():
    values, views = randoms(2, 3, 4, 5).requires_grad_(), anyhow(2, (3, 5))
    grid = Grid((3, 4, 5), (1.1, 0.8, 0.9), (-1.8, -1.2, -1.1))
    assert torch.autograd.gradcheck(lambda v: voxel_line_integrals(v, grid, views, rays=2), values)


# --- lengths of paths ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("angle", [0.0, 90.0, 180.0, 31.0, -52.0])
def test_path_through_a_slab(angle):
    """A slab of thickness t across z is crossed over `t / |cos θ|`; end on, over all of its length."""
    grid = Grid((31, 5, 61), (0.9, 1.0, 0.7), (-27.0, -2.0, -10.5))
    slab = torch.zeros(grid.shape, dtype=DOUBLE)
    slab[13:18] = 1  # 5 voxels: 3.5 thick
    views = Views.from_angles([angle], (5, 3), 1.0)
    truth = 61 * 0.9 if angle == 90 else 3.5 / abs(np.cos(np.deg2rad(angle)))
    rays = voxel_line_integrals(slab[None], grid, views, step=0.25)[:, 0]
    assert torch.allclose(slices_of(slab, grid, views), torch.full_like(rays, truth), rtol=1e-5)
    assert torch.allclose(rays, torch.full_like(rays, truth), rtol=3e-3)


def test_a_voxel_casts_the_shadow_of_a_square():
    """One voxel's slice image is the chord of its rectangle, averaged over pixels (here: over 2000 rays)."""
    views, grid = around(6, (1, 15), 0.37), Grid((5, 1, 5), (1.4, 1.0, 2.3), (-2.0, 0.0, -3.0))
    volume = torch.zeros(grid.shape, dtype=DOUBLE)
    volume[1, 0, 3] = 1
    centre, half = np.array([-2 + 3 * 1.4, -3 + 2.3]), np.array([0.7, 1.15])  # (x, z)
    x = (np.arange(30000) + 0.5 - 15000) / 2000
    for image, rotation, shift in zip(slices_of(volume, grid, views), views.rotations, views.shifts):
        start = (x[:, None] + shift[0]) * rotation[0, ::2] - centre
        with np.errstate(divide="ignore"):
            one, other = (-half - start) / rotation[2, ::2], (half - start) / rotation[2, ::2]
        chord = np.clip(np.maximum(one, other).min(1) - np.minimum(one, other).max(1), 0, None)
        assert chord.max() > 1.3
        assert np.abs(image[0].numpy() - chord.reshape(15, 2000).mean(1)).max() < 2e-3


def test_mass_is_kept():
    """Σ line integrals · p² is Σ values · voxel volume, in every view that sees all."""
    volume = randoms(*ROWS.shape).abs()
    mass = float(volume.sum()) * np.prod(ROWS.voxel_size)
    views = around(7, (7, 21), 0.3)
    assert np.allclose(slices_of(volume, ROWS, views).sum((1, 2)), mass, rtol=1e-6)
    wide = anyhow(4, (25, 27))
    fine = voxel_line_integrals(volume[None], ROWS, wide, step=0.25, rays=4)[:, 0]
    assert np.allclose(fine.sum((1, 2)), mass, rtol=2e-3)
    lattice = LatticeProjector(CUBIC, wide).project(volume.float())
    assert np.allclose(lattice.sum((1, 2)), float(volume.sum()) * 0.9**3, rtol=1e-5)


# --- against Gaussians --------------------------------------------------------------------------------------


CENTRE, SCALES, TURN = (0.6, -0.4, 0.9), (1.6, 2.3, 1.9), (0.9, 0.2, -0.3, 0.25)


def gaussian_lines(views: Views) -> Tensor:
    """Line integrals [V, H, W] of one turned Gaussian at pixel centres, by the splat's float64 reference."""
    p = views.pixel_size
    rows = (np.divide(CENTRE, p), np.divide(SCALES, p), TURN, [p])
    cloud = [torch.tensor(np.array([row]), dtype=DOUBLE) for row in rows]
    exact = {"backend": "reference", "cutoff": 8.0, "pixel_variance": 0.0}
    return splat(*cloud, views.rotations, views.shifts / p, views.shape, **exact)[:, 0]


def gaussian_voxels(grid: Grid) -> Tensor:
    """The same Gaussian [Z, Y, X] sampled at voxel centres."""
    x, y, z = grid.axes()
    away = np.stack(np.broadcast_arrays(x, y[:, None], z[:, None, None]), -1) - CENTRE
    own = away @ Rotation.from_quat(np.roll(TURN, -1)).as_matrix()
    return torch.from_numpy(np.exp(-0.5 * ((own / SCALES) ** 2).sum(-1)))


def orders(errors: list[float]) -> np.ndarray:
    """log₂ of the ratios of successive errors."""
    return -np.diff(np.log2(errors))


def test_rays_converge_to_gaussians_in_any_pose():
    """Trilinear interpolation of samples is of second order in the voxel's edge."""
    views, errors = anyhow(4, (15, 19)), []
    truth = gaussian_lines(views)
    for n in (1, 2, 4):
        shape, size = (27 * n, 25 * n, 29 * n), (0.8 / n, 0.9 / n, 0.85 / n)
        low = tuple(-0.5 * (count - 1) * edge for count, edge in zip(shape[::-1], size))
        grid = Grid(shape, size, low)
        lines = voxel_line_integrals(gaussian_voxels(grid)[None], grid, views)[:, 0]
        errors.append(float((lines - truth).abs().max() / truth.max()))
    assert np.all(np.abs(orders(errors) - 2) < 0.2), errors
    assert errors[-1] < 6e-3


def test_slices_converge_to_gaussians():
    """Boxes of constant value, integrated over pixels: of second order when both shrink."""
    views, errors = around(6, (21, 31), 0.21), []
    for n in (1, 2, 4):
        fine = views.refined(n)
        grid = Grid.of_views(fine)
        truth = gaussian_lines(fine)
        errors.append(float((slices_of(gaussian_voxels(grid), grid, fine) - truth).abs().max() / truth.max()))
    assert np.all(np.abs(orders(errors) - 2) < 0.25), errors
    assert errors[-1] < 6e-3


def test_the_lattice_converges_to_gaussians_in_any_pose():
    """Bilinear hats of voxels as large as pixels: of second order when both shrink, in the mean over coarse pixels.

    Pixel by pixel there is a ripple on top (here up to 4 and 2 %), where few rows of voxels line up with the rays.
    """
    views, errors, ripples = anyhow(4, (21, 25)), [], []
    for n in (2, 4):
        fine, grid = views.refined(n), Grid.centred((27 * n, 25 * n, 29 * n), 1 / n)
        truth = gaussian_lines(fine)
        error = (LatticeProjector(grid, fine).project(gaussian_voxels(grid).float()) - truth) / truth.max()
        errors.append(float(avg_pool2d(error[None], n).abs().max()))
        ripples.append(float(error.abs().max()))
    assert abs(orders(errors)[0] - 2) < 0.25, errors
    assert errors[-1] < 4e-3
    assert np.all(np.array(ripples) < (0.05, 0.025)), ripples


def test_order_of_convergence_in_the_step():
    """The sum along a ray is of second order in the step, in the mean over rays."""
    views, volume = anyhow(5, (6, 9)), randoms(*UNEVEN.shape)
    finest = voxel_line_integrals(volume[None], UNEVEN, views, step=1 / 64)
    errors = [
        float((voxel_line_integrals(volume[None], UNEVEN, views, step=s) - finest).square().mean().sqrt())
        for s in (1.0, 0.5, 0.25, 0.125)
    ]
    assert np.all(orders(errors) > 1.5), errors
    assert -np.log2(errors[-1] / errors[0]) / 3 == pytest.approx(2, abs=0.35)


# --- geometry -----------------------------------------------------------------------------------------------


def test_a_detector_shift_moves_the_object_back():
    views, volume = anyhow(3, (7, 12)), randoms(1, *UNEVEN.shape)
    seen = voxel_line_integrals(volume, UNEVEN, views)[:, 0]
    assert float(seen.abs().max()) > 1
    for v, (rotation, shift) in enumerate(zip(views.rotations, views.shifts)):
        origin = np.array(UNEVEN.origin) - rotation.T @ [*shift, 0]
        still = replace(views[[v]], shifts=np.zeros((1, 2)))
        moved = voxel_line_integrals(volume, replace(UNEVEN, origin=tuple(origin)), still)[0, 0]
        assert torch.allclose(moved, seen[v], atol=1e-12)


def test_whole_pixels_of_shift_roll_the_frame():
    views, volume = around(4, (7, 16)), randoms(*ROWS.shape)
    moved = replace(views, shifts=views.shifts + [2.0, 0.0])
    for cast in (slices_of, lambda u, grid, v: voxel_line_integrals(u[None], grid, v)[:, 0]):
        here, there = (cast(volume, ROWS, v) for v in (views, moved))
        assert torch.allclose(there[..., :-2], here[..., 2:], atol=1e-5)


def test_turning_the_object_is_turning_the_view():
    """A quarter turn about y maps voxels on voxels: `x_lab = R x_obj` with R(90°) = (z, y, -x)."""
    grid = Grid.centred((9, 7, 9), 1.0)
    volume = randoms(*grid.shape)
    turned = volume.transpose(0, 2).flip(0)  # turned[z, y, x] = volume[x, y, -z]
    for angle in (0.0, 23.0):
        here, there = Views.from_angles([angle + 90], (7, 13), 1.0), Views.from_angles([angle], (7, 13), 1.0)
        for cast in (slices_of, lambda u, g, v: voxel_line_integrals(u[None], g, v)[:, 0]):
            assert torch.allclose(cast(volume, grid, here), cast(turned, grid, there), atol=1e-5)


def test_rays_of_a_pixel_are_averaged():
    views, volume = anyhow(2, (5, 9)), randoms(2, *UNEVEN.shape)
    fine = voxel_line_integrals(volume, UNEVEN, views.refined(3))
    mean = fine.reshape(2, 2, 5, 3, 9, 3).mean((3, 5))
    assert torch.allclose(voxel_line_integrals(volume, UNEVEN, views, rays=3), mean, atol=1e-12)


def test_the_fastest_projector_that_fits_is_taken():
    assert isinstance(projector_for(ROWS, around(3, (7, 12), 0.3)), SliceProjector)
    assert isinstance(projector_for(Grid.of_views(around(3, (7, 12))), around(3, (7, 12))), SliceProjector)
    moved = around(3, (7, 12))
    down = replace(moved, shifts=moved.shifts + [0.0, 0.4])
    lower = replace(CUBES, origin=(CUBES.origin[0], CUBES.origin[1] + 0.4, CUBES.origin[2]))
    assert isinstance(projector_for(lower, down), SliceProjector)
    tilt = Rotation.from_euler("x", 1, degrees=True).as_matrix()
    for grid, views in (
        (CUBIC, moved),  # rows of another height
        (CUBES, around(3, (8, 12))),  # more rows
        (CUBES, down),  # rows between the grid's
        (CUBES, replace(moved, shifts=np.array([[0, 0], [0, 0.4], [0, 0]]))),  # rows differ between views
        (CUBES, anyhow(3, (7, 12))),  # no common axis
        (CUBES, replace(moved, rotations=moved.rotations @ tilt)),  # a common axis, but not y
    ):
        assert isinstance(projector_for(grid, views), LatticeProjector)
        with pytest.raises(InputError, match="slice matrices need"):
            SliceProjector(grid, views)


def test_bad_input_is_named():
    with pytest.raises(InputError, match="values must have the shape"):
        voxel_line_integrals(torch.zeros(1, 7, 11, 9), UNEVEN, anyhow(1, (5, 7)))
    with pytest.raises(InputError, match="step must be positive"):
        voxel_line_integrals(torch.zeros(1, *UNEVEN.shape), UNEVEN, anyhow(1, (5, 7)), step=0.0)
