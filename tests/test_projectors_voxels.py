"""Voxel projectors against closed forms and each other, and the total-variation solver that runs on them.

Lengths are in units of the detector's pitch. Grids are odd and not cubic, with uneven voxels but for the rows
that slices need; detectors are rectangular.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.nn.functional import avg_pool2d

from holosplat.baselines import PrimalDual
from holosplat.baselines.tv_steps import cpu, reference
from holosplat.checks import InputError
from holosplat.geometry import Grid, Views
from holosplat.projectors.splat import splat
from holosplat.projectors.voxels import (
    LatticeProjector,
    SliceProjector,
    projector_for,
    voxel_line_integrals,
)
from holosplat.projectors.voxels.lattice import lattice_reference

DOUBLE = torch.float64
UNEVEN = Grid((11, 7, 9), (1.1, 0.8, 0.9), (-4.0, -2.9, -3.7))
ROWS = Grid((11, 7, 9), (1.1, 1.0, 0.9), (-4.0, -3.0, -3.7))
"""Rows along y are those of a detector of 7 rows of pitch 1."""
CUBES = Grid((11, 7, 9), (1.0, 1.0, 1.0), (-4.0, -3.0, -4.7))
"""Such rows and cubic voxels at once."""
CUBIC = Grid((11, 7, 9), (0.9, 0.9, 0.9), (-4.0, -2.9, -3.7))
"""Cubic voxels only."""


@pytest.fixture(scope="module", autouse=True)
def _one_thread() -> Iterator[None]:
    """Arrays are tiny here: a second thread would only wait for the first."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def around(count: int, shape: tuple[int, int], shift: float = 0.0) -> Views:
    """Views about y at odd angles and both axes' own, with a detector shift of their own along x."""
    angles = np.concatenate([[0.0, 90.0], np.linspace(13, 167, count)])[:count]
    shifts = np.stack([shift * np.arange(count), np.zeros(count)], 1)
    return replace(Views.from_angles(angles, shape, 1.0), shifts=shifts)


def anyhow(count: int, shape: tuple[int, int], seed: int = 0) -> Views:
    """Views from all directions, with shifts along both axes."""
    shifts = np.random.default_rng(seed).uniform(-1, 1, (count, 2))
    return Views(Rotation.random(count, rng=seed).as_matrix(), shifts, shape, 1.0)


def randoms(*shape: int, seed: int = 0, dtype: torch.dtype = DOUBLE) -> Tensor:
    """Normal random numbers."""
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


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
    scaled = replace(views, pixel_size=metre, shifts=views.shifts * metre)
    grid = replace(CUBIC, voxel_size=(0.9 * metre,) * 3, origin=tuple(metre * o for o in CUBIC.origin))
    truth = lattice_reference(volume, CUBIC, views)
    torch.set_num_threads(threads)
    lines = [
        LatticeProjector(g, v).project(volume.float()) / u for g, v, u in ((CUBIC, views, 1), (grid, scaled, metre))
    ]
    torch.set_num_threads(1)
    for image in lines:
        assert float((image.double() - truth).abs().max() / truth.abs().max()) < 1e-5


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
    rays = voxel_line_integrals(slab[None], grid, views, step=0.25)[0]
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
    fine = voxel_line_integrals(volume[None], ROWS, wide, step=0.25, rays=4)[0]
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
        lines = voxel_line_integrals(gaussian_voxels(grid)[None], grid, views)[0]
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
    seen = voxel_line_integrals(volume, UNEVEN, views)[0]
    assert float(seen.abs().max()) > 1
    for v, (rotation, shift) in enumerate(zip(views.rotations, views.shifts)):
        origin = np.array(UNEVEN.origin) - rotation.T @ [*shift, 0]
        still = replace(views[[v]], shifts=np.zeros((1, 2)))
        moved = voxel_line_integrals(volume, replace(UNEVEN, origin=tuple(origin)), still)[0, 0]
        assert torch.allclose(moved, seen[v], atol=1e-12)


def test_whole_pixels_of_shift_roll_the_frame():
    views, volume = around(4, (7, 16)), randoms(*ROWS.shape)
    moved = replace(views, shifts=views.shifts + [2.0, 0.0])
    for cast in (slices_of, lambda u, grid, v: voxel_line_integrals(u[None], grid, v)[0]):
        here, there = (cast(volume, ROWS, v) for v in (views, moved))
        assert torch.allclose(there[..., :-2], here[..., 2:], atol=1e-5)


def test_turning_the_object_is_turning_the_view():
    """A quarter turn about y maps voxels on voxels: `x_lab = R x_obj` with R(90°) = (z, y, -x)."""
    grid = Grid.centred((9, 7, 9), 1.0)
    volume = randoms(*grid.shape)
    turned = volume.transpose(0, 2).flip(0)  # turned[z, y, x] = volume[x, y, -z]
    for angle in (0.0, 23.0):
        here, there = Views.from_angles([angle + 90], (7, 13), 1.0), Views.from_angles([angle], (7, 13), 1.0)
        for cast in (slices_of, lambda u, g, v: voxel_line_integrals(u[None], g, v)[0]):
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
    with pytest.raises(InputError, match="needs cubic voxels"):
        LatticeProjector(UNEVEN, anyhow(1, (5, 7)))
    with pytest.raises(InputError, match="step must be positive"):
        voxel_line_integrals(torch.zeros(1, *UNEVEN.shape), UNEVEN, anyhow(1, (5, 7)), step=0.0)


# --- total variation ----------------------------------------------------------------------------------------


def gradient(u: np.ndarray) -> np.ndarray:
    """Forward differences [3, Z, Y, X], zero at the last voxel of each axis."""
    return np.stack([np.diff(u, axis=a, append=u.take([-1], axis=a)) for a in range(3)])


def gradient_adjoint(q: np.ndarray) -> np.ndarray:
    """The transpose of `gradient`, made from its definition voxel by voxel."""
    out = np.zeros(q.shape[1:])
    for a in range(3):
        p, u = np.moveaxis(q[a], a, 0), np.moveaxis(out, a, 0)
        for i in range(len(p) - 1):
            u[i + 1] += p[i]
            u[i] -= p[i]
    return out


SHAPES = [(5, 7, 9), (1, 7, 3), (4, 1, 18), (3, 5, 1), (2, 3, 33)]


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("steps", [cpu, reference])
def test_ascent_equals_its_float64_twin(shape, threads, steps):
    u, q = randoms(*shape, dtype=torch.float32), randoms(3, *shape, seed=1, dtype=torch.float32)
    q[0, -1] = q[1, :, -1] = q[2, :, :, -1] = 0  # as a solver starts: there is no voxel beyond the last
    moved = q.double().numpy() + 0.5 * gradient(u.double().numpy())
    want = moved / np.maximum(1, np.linalg.norm(moved, axis=0) / 0.8)
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    steps.ascend(u, q, 0.5, 0.8)
    torch.set_num_threads(before)
    assert np.abs(q.numpy() - want).max() < 1e-6
    assert np.linalg.norm(q.numpy(), axis=0).max() < 0.8 * (1 + 1e-6)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("upper", [0.7, float("inf")])
@pytest.mark.parametrize("steps", [cpu, reference])
def test_descent_equals_its_float64_twin(shape, upper, steps):
    u, slope = (randoms(*shape, seed=s, dtype=torch.float32) for s in (2, 3))
    tau, q = (
        0.1 + randoms(*shape, seed=4, dtype=torch.float32).abs(),
        randoms(3, *shape, seed=5, dtype=torch.float32),
    )
    old, wide = u.double().numpy().copy(), torch.empty_like(u)
    q[0, -1] = q[1, :, -1] = q[2, :, :, -1] = 0  # as ascent keeps them: there is no voxel beyond the last
    a, b, c = (t.double().numpy() for t in (slope, tau, q))
    want = np.clip(old - b * (a + 0.3 * gradient_adjoint(c)), 0, upper)
    steps.descend(slope, tau, q, 0.3, upper, u, wide)
    assert np.abs(u.numpy() - want).max() < 1e-6
    assert np.abs(wide.numpy() - (2 * want - old)).max() < 2e-6
    assert float(u.min()) == 0


def test_the_twins_are_adjoint():
    u, q = np.random.default_rng(0).normal(size=(5, 7, 9)), np.random.default_rng(1).normal(size=(3, 5, 7, 9))
    assert (gradient(u) * q).sum() == pytest.approx((u * gradient_adjoint(q)).sum(), rel=1e-12)


class Identity:
    """A projector that sees the volume itself: the solver then denoises, with solutions known on paper."""

    def __init__(self, shape: tuple[int, int, int]) -> None:
        self.array_shape = shape

    def project(self, array: Tensor) -> Tensor:
        return array.clone()

    backproject = volume_in = volume_out = lines_in = lines_out = project


def solve(images: Tensor, weight: float, upper: float | None = None, coupling=1.0, start=0.0) -> Tensor:
    """The denoised volume after many steps."""
    solver = PrimalDual(Identity(tuple(images.shape)), torch.full_like(images, start), weight, upper, coupling)
    solver.run(images, 600)
    return solver.volume


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("coupling", [1.0, 0.25, 3.0])
def test_a_step_is_denoised_as_on_paper(axis, coupling):
    """Rudin–Osher–Fatemi in one dimension: plateaus of n voxels move by λ/n, each to the other."""
    step = torch.zeros(7)
    step[4:] = 1.0
    shape = [3, 3, 3]
    shape[axis] = 7
    images = (0.5 + step).reshape([-1 if a == axis else 1 for a in range(3)]).expand(shape).contiguous()
    want = 0.5 + 0.3 / 4 + step * (1 - 0.3 / 3 - 0.3 / 4)
    found = solve(images, 0.3, coupling=coupling)
    assert torch.allclose(found.movedim(axis, -1), want.expand(3, 3, 7), atol=1e-4)
    assert torch.allclose(solve(images, 5.0, coupling=coupling), images.mean().expand(shape), atol=1e-3)


def test_the_box_holds():
    """Without total variation every voxel is clamped by itself; with it, the values still stay inside."""
    images = randoms(3, 5, 7, dtype=torch.float32) * 2
    assert torch.allclose(solve(images, 1e-9, upper=1.0), images.clamp(0, 1), atol=1e-4)
    assert torch.allclose(solve(images, 1e-9), images.clamp_min(0), atol=1e-4)
    assert float(solve(images, 0.2, upper=1.0).max()) <= 1


def test_no_weight_is_no_total_variation():
    images = randoms(3, 5, 7, dtype=torch.float32)
    assert torch.allclose(solve(images, 0.0), images.clamp_min(0), atol=1e-4)


def test_steps_are_those_of_the_algorithm():
    """Chambolle & Pock (2011), algorithm 1, in float64, with the preconditioned steps of the solver's docstring."""
    images, weight, coupling, upper = randoms(3, 5, 7, dtype=torch.float32), 0.2, 0.5, 0.9
    solver = PrimalDual(Identity((3, 5, 7)), torch.full_like(images, 0.4), weight, upper, coupling)
    solver.run(images, 6)
    b, u, p, q = images.double().numpy(), np.full(images.shape, 0.4), np.zeros(images.shape), np.zeros((3, 3, 5, 7))
    ahead, tau, radius = u, 1 / (1 + 6 * coupling), weight / coupling
    for _ in range(6):
        p = (p + (ahead - b)) / 2
        q = q + 0.5 * gradient(ahead)
        q = q / np.maximum(1, np.linalg.norm(q, axis=0) / radius)
        fresh = np.clip(u - tau * (p + coupling * gradient_adjoint(q)), 0, upper)
        u, ahead = fresh, 2 * fresh - u
    assert np.abs(solver.volume.numpy() - u).max() < 1e-6


def test_the_solution_does_not_depend_on_the_start():
    images = randoms(3, 5, 7, dtype=torch.float32)
    assert torch.allclose(solve(images, 0.2), solve(images, 0.2, start=3.0), atol=1e-3)


def test_steps_may_be_taken_in_pieces():
    views = around(3, (7, 12))
    images = randoms(3, 7, 12, dtype=torch.float32).abs()
    once, twice = (PrimalDual(SliceProjector(ROWS, views), torch.zeros(ROWS.shape), 0.3, 1.0) for _ in range(2))
    once.run(images, 12)
    twice.run(images, 5)
    twice.run(images, 7)
    assert torch.equal(once.volume, twice.volume)
    assert torch.equal(once.lines(), twice.lines())


def cylinder(grid: Grid) -> Tensor:
    """Occupancy [Z, Y, X] of a short elliptic cylinder inside the grid."""
    x, y, z = grid.axes()
    inside = ((x / 4) ** 2 + (z[:, None, None] / 3) ** 2 < 1) & (np.abs(y[:, None]) < 2)
    return torch.from_numpy(inside).float()


def test_tomography_decreases_its_objective_and_finds_the_object():
    """From 8 exact views of a flat object, with `½‖A u - b‖² + λ Σ|∇u|`; the start is the worst."""
    views, weight = around(8, (9, 15)), 0.02
    grid = Grid.of_views(views)
    truth = cylinder(grid)
    projector = projector_for(grid, views)
    images = projector.lines_out(projector.project(projector.volume_in(truth)))
    solver = PrimalDual(projector, torch.full(grid.shape, 0.3), weight, 1.0)

    def objective(volume: Tensor, lines: Tensor) -> float:
        norms = np.linalg.norm(gradient(volume.double().numpy()), axis=0)
        return 0.5 * float((lines - images).double().square().sum()) + weight * float(norms.sum())

    values = [objective(solver.volume, solver.lines())]
    for steps in (10, 40, 150, 400):
        solver.run(images, steps)
        values.append(objective(solver.volume, solver.lines()))
    assert np.all(np.diff(values) < 0), values
    assert values[-1] < 1.001 * objective(truth, images)  # no worse than the truth, which has no residual
    assert float((solver.volume - truth).abs().mean()) < 0.02
    assert torch.equal(solver.volume > 0.5, truth > 0.5)


def test_tomography_runs_on_views_without_a_common_axis():
    grid, views = Grid.centred((7, 5, 9), 1.0), anyhow(6, (11, 13))
    truth, projector = cylinder(grid), LatticeProjector(grid, views)
    solver = PrimalDual(projector, torch.zeros(grid.shape), 0.02, 1.0)
    solver.run(projector.project(truth), 50)
    assert float((solver.volume - truth).abs().mean()) < 0.02


def test_plain_and_compiled_tomography_agree():
    """The same solver on the same projections, with the compiled kernels and with none of them."""
    views = Views.from_rotations(Rotation.random(3, rng=0).as_matrix(), (9, 8), 1.0)
    grid = Grid.centred((7, 6, 8), 1.0)
    truth = torch.zeros(grid.shape)
    truth[2:5, 2:4, 3:6] = 0.8
    volumes = []
    for backend in ("cpu", "reference"):
        projector = LatticeProjector(grid, views, backend)
        solver = PrimalDual(projector, torch.zeros(grid.shape), 0.05, 1.0, backend=backend)
        solver.run(projector.project(truth), 20)
        volumes.append(solver.volume)
    assert float((volumes[0] - volumes[1]).abs().max()) < 1e-5
    assert float(volumes[0].max()) > 0.3


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_arrays_of_another_shape_are_refused(backend):
    projector = LatticeProjector(Grid.centred((4, 5, 6), 1.0), Views.evenly_spaced(2, (7, 8), 1.0), backend)
    with pytest.raises(InputError, match=r"volume must have the shape \(4, 5, 6\)"):
        projector.project(torch.ones(2, 2, 2))
    with pytest.raises(InputError, match=r"line integrals must have the shape \(2, 7, 8\)"):
        projector.backproject(torch.ones(1, 7, 8))
