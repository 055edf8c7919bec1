"""Voxel grids and neural fields as Objects: line integrals against closed forms, resampling, gradients."""

from __future__ import annotations

import math
from unittest.mock import patch

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from helpers.voxels import pronounced
from holosplat.backends import implementation
from holosplat.checks import InputError
from holosplat.geometry import Grid, Views
from holosplat.matter import Matter
from holosplat.representations import VoxelGrid, VoxelLines
from holosplat.representations.voxels import resampling
from holosplat.volume import Object
from holosplat_bench.opponents.fields import Encoding, Network, NeuralField
from holosplat_bench.opponents.fields.neural_field import grown

PIXEL = 2e-6
SMALL = Network(Encoding(levels=2, features=2, coarsest=8.0, finest=3.0, log2_size=10), hidden=8, layers=1)


def about_axis(count: int = 3, shape: tuple[int, int] = (21, 27), pixel: float = PIXEL) -> Views:
    """Views about y with shifted detectors."""
    views = Views.from_angles(np.arange(count) * 37.0 + 5, shape, pixel)
    return Views(views.rotations, np.tile([1.3 * PIXEL, 0.4 * PIXEL], (count, 1)), shape, pixel)


def any_pose(count: int = 3, shape: tuple[int, int] = (21, 27), pixel: float = PIXEL) -> Views:
    """Views without a common axis."""
    return Views(Rotation.random(count, rng=3).as_matrix(), np.full((count, 2), 0.7 * PIXEL), shape, pixel)


POSES = {"axis": about_axis, "any": any_pose}


def ball(grid: Grid, radius: float, centre: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> torch.Tensor:
    """Share of each voxel [1, Z, Y, X] inside a ball [m], from 5³ points."""
    fine = grid.divided((5, 5, 5))
    x, y, z = (axis - c for axis, c in zip(fine.axes(), centre))
    inside = (z[:, None, None] ** 2 + y[:, None] ** 2 + x**2 < radius**2).astype(np.float32)
    nz, ny, nx = grid.shape
    return torch.from_numpy(inside.reshape(nz, 5, ny, 5, nx, 5).mean((1, 3, 5)))[None]


def chord(views: Views, radius: float, centre: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> np.ndarray:
    """Mean length [V, H, W] of the rays' chords through a ball over each pixel [m], from 5² points."""
    fine, found = views.refined(5), []
    h, w = fine.shape
    for rotation, shift in zip(views.rotations, views.shifts):
        at = rotation @ np.array(centre)
        x = (np.arange(w) + 0.5 - 0.5 * w) * fine.pixel_size + shift[0] - at[0]
        y = (np.arange(h) + 0.5 - 0.5 * h) * fine.pixel_size + shift[1] - at[1]
        found.append(2 * np.sqrt(np.clip(radius**2 - y[:, None] ** 2 - x**2, 0, None)))
    return np.stack(found).reshape(len(views), h // 5, 5, w // 5, 5).mean((2, 4))


# --- voxels -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("poses", "most"), [("axis", 0.016), ("any", 0.025)])
@pytest.mark.parametrize("finer", [1, 2])
def test_a_ball_casts_its_chords(poses, most, finer):
    """To a few per cent (rms) of its diameter of 14 voxels, away from the rim, where voxels are too coarse."""
    grid = Grid((27, 23, 25), (PIXEL,) * 3, tuple(-0.5 * (n - 1) * PIXEL for n in (25, 23, 27)))
    radius, centre = 7 * PIXEL, (1.5 * PIXEL, -0.6 * PIXEL, 0.8 * PIXEL)
    views = POSES[poses]().padded((2, 3)).refined(finer)
    lines = VoxelGrid(ball(grid, radius, centre), grid, Matter.one(2.0, 1.0)).project(views)
    true = chord(views, radius, centre)
    inner = true > radius
    error = (lines.channels[:, 0].numpy() - true) / (2 * radius)
    assert np.sqrt(np.mean(error[inner] ** 2)) < most
    assert np.sqrt(np.mean(error**2)) < 0.022
    b, d = lines
    assert torch.equal(d, 2 * lines.channels[:, 0])
    assert torch.equal(b, lines.channels[:, 0])


@pytest.mark.parametrize("poses", ["axis", "any"])
@pytest.mark.parametrize("pixel", [PIXEL, 0.5 * PIXEL, 1.6 * PIXEL])
def test_projection_conserves_mass(poses, pixel):
    grid = Grid.centred((9, 11, 7), PIXEL)
    values = torch.rand(2, *grid.shape, generator=torch.Generator().manual_seed(1))
    values[:, :, [0, -1]] = 0  # the ends of the grid fall anywhere between the rows of the detector
    count = math.ceil(24 * PIXEL / pixel)
    lines = VoxelLines(grid, POSES[poses](2, (count + 1, count), pixel))(values)
    mass = lines.sum(dim=(2, 3)) * pixel**2
    expected = (values.sum(dim=(1, 2, 3)) * PIXEL**3).expand(2, 2)
    assert torch.allclose(mass, expected, rtol=2e-5 if poses == "axis" else 2e-4, atol=0)


@pytest.mark.parametrize("poses", ["axis", "any"])
def test_backends_project_voxels_alike(poses):
    """And each is asked for: line integrals and gradients, with empty voxels among others."""
    grid, found = Grid.centred((9, 11, 7), PIXEL), []
    values = torch.rand(1, *grid.shape, generator=torch.Generator().manual_seed(3))
    values[:, 2:5] = 0
    for backend in ("cpu", "reference"):
        values = values.detach().requires_grad_()
        with (
            patch("holosplat.projectors.voxels.lattice.implementation", side_effect=implementation) as lattice,
            patch("holosplat.projectors.voxels.slices.implementation", side_effect=implementation) as strips,
        ):
            lines = VoxelLines(grid, POSES[poses](2, (13, 15)), backend)(values)
        asked = {call.args[1] for call in (*lattice.call_args_list, *strips.call_args_list)}
        assert asked == {backend}
        (gradient,) = torch.autograd.grad(lines.square().sum(), values)
        found.append((lines.detach() / PIXEL, gradient / PIXEL**2))
    for one, other in zip(*found):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("poses", ["axis", "any"])
@pytest.mark.parametrize("finer", [1, 2])
def test_the_gradient_is_the_adjoint(poses, finer):
    grid = Grid.centred((9, 11, 7), PIXEL)
    lines = VoxelLines(grid, POSES[poses](2, (13, 15)).refined(finer))
    generator = torch.Generator().manual_seed(2)
    values = torch.rand(1, *grid.shape, generator=generator, requires_grad=True)
    images = lines(values)
    other = torch.rand(images.shape, generator=generator)
    left = float((images.detach().double() * other.double()).sum())
    images.backward(other)
    assert values.grad is not None
    assert left == pytest.approx(float((values.detach().double() * values.grad.double()).sum()), rel=1e-5)


def test_uneven_voxels_about_the_axis():
    grid = Grid((10, 14, 12), (PIXEL, 0.8 * PIXEL, 1.4 * PIXEL), (-5.5 * PIXEL, -5.2 * PIXEL, -6.3 * PIXEL))
    values = torch.ones(1, *grid.shape)
    lines = VoxelLines(grid, Views.from_angles([0.0, 90.0], (20, 20), PIXEL))(values)[:, 0]
    assert torch.allclose(lines[0, 10, 6:14], torch.tensor(14 * PIXEL), atol=0)
    assert torch.allclose(lines[1, 10, 6:14], torch.tensor(12 * PIXEL), atol=0)


def test_voxels_are_resampled_without_loss():
    grid = Grid.centred((8, 6, 10), PIXEL)
    values = torch.rand(2, *grid.shape, generator=torch.Generator().manual_seed(4))
    voxels = VoxelGrid(values, grid, Matter.free(3.0, 0.5))
    assert voxels.resampled(grid) is voxels
    assert np.array_equal(voxels.voxelise(grid).delta, 3 * values[0].numpy())
    assert np.array_equal(voxels.voxelise(grid).beta, 0.5 * values[1].numpy())
    coarse = voxels.resampled(Grid.centred((4, 3, 5), 2 * PIXEL)).values
    blocks = values.reshape(2, 4, 2, 3, 2, 5, 2).mean((2, 4, 6))
    assert torch.allclose(coarse, blocks, atol=1e-6)
    for target in (grid.divided((3, 3, 3)), Grid.centred((16, 16, 16), 1.37 * PIXEL)):
        mass = voxels.resampled(target).values.sum((1, 2, 3)) * target.voxel_size[0] ** 3
        assert torch.allclose(mass, values.sum((1, 2, 3)) * PIXEL**3, rtol=1e-5, atol=0)
    ramp = resampling((5, 1.0, 0.0), (10, 0.5, -0.25)) @ torch.arange(5.0)
    assert torch.allclose(ramp[1:9], torch.arange(8) * 0.5 + 0.25)
    assert not resampling((5, 1.0, 0.0), (3, 1.0, 20.0)).any()


def test_voxels_are_objects_of_a_known_size():
    grid = Grid.centred((3, 4, 5), PIXEL)
    one = VoxelGrid(torch.rand(1, 3, 4, 5), grid, Matter.one(1e-6, -1e-9))
    assert isinstance(one, Object)
    assert one.at(3.0) is one
    two = one.freed()
    assert two.matter == Matter.free(1e-6, -1e-9)
    views = about_axis(1)
    assert all(torch.allclose(a, b, atol=0) for a, b in zip(one.project(views), two.project(views)))
    with pytest.raises(InputError, match="voxel values must have the shape"):
        VoxelGrid(torch.rand(3, 3, 4, 5), grid, Matter.free(1.0, 1.0))


# --- neural fields ------------------------------------------------------------------------------------------


ONE = Matter.one(1.0, 0.0)


def smooth(
    grid: Grid,
    matter: Matter = ONE,
    network: Network = SMALL,
    mask: torch.Tensor | None = None,
    upper: float = 1.0,
    lower: float = 0.0,
) -> NeuralField:
    """A field with some structure, in float64."""
    full = torch.ones(grid.shape, dtype=torch.bool) if mask is None else mask
    return pronounced(NeuralField(grid, matter, network, full, 1, upper, lower=lower))


@pytest.mark.parametrize("kind", ["hash", "fourier"])
def test_line_integrals_converge_with_the_square_of_the_step(kind):
    """On the same rays, steps of a third of the length; and without rotation they are sums over its own voxels."""
    found = []
    for factor in (1, 3, 9):
        grid = Grid.centred((8, 5, 10), PIXEL).divided((factor, factor, factor))
        encoding = Encoding(kind, 2, 2, 6.0 * factor, 6.0 * factor, 12, waves=4, bandwidth=0.03 / factor)
        field = smooth(grid, ONE, Network(encoding, 8, 1))
        with torch.no_grad():
            lines = field.project(Views.from_angles([0.0, 90.0], (grid.shape[1], grid.shape[2]), grid.voxel_size[0]))
        own = field.values(grid)[0].sum(dim=0) * grid.voxel_size[0]
        assert torch.allclose(lines.channels[0, 0], own, atol=0)
        middle = factor // 2
        found.append(lines.channels[:, 0, middle::factor, middle::factor])
    errors = [float((coarse - found[2]).square().mean().sqrt()) for coarse in found[:2]]
    assert errors[0] < 0.02 * float(found[2].square().mean().sqrt())
    assert errors[1] < errors[0] / 6


@pytest.mark.parametrize("poses", ["axis", "any"])
def test_projections_are_those_of_its_own_voxels(poses):
    """Within what samples a voxel apart see of the rim of the mask."""
    grid, views = Grid.centred((9, 9, 9), PIXEL).divided((3, 3, 3)), POSES[poses](2, (11, 11), PIXEL)
    field = smooth(grid, ONE, SMALL, ball(grid, 4 * PIXEL)[0] > 0.5)
    with torch.no_grad():
        rays = field.project(views).channels[:, 0]
    voxels = VoxelGrid(field.values(grid).float(), grid, ONE).project(views).channels[:, 0]
    assert float((rays - voxels).square().mean() / voxels.square().mean()) < 0.05**2


def test_a_uniform_field_has_the_length_of_its_box():
    grid = Grid.centred((12, 9, 15), PIXEL)
    field = smooth(grid, Matter.one(1.0, 0.5), upper=2.0)
    output = {name: 0 * p for name, p in field.parameters().items() if name.startswith("output.")}
    field = field.with_parameters(output)
    lines = field.project(Views.from_angles([0.0, 90.0], (9, 11), PIXEL)).channels[:, 0]
    assert torch.allclose(lines[0, 4], torch.tensor(12 * PIXEL, dtype=torch.float64), atol=0)
    assert torch.allclose(lines[1, 4], torch.tensor(15 * PIXEL, dtype=torch.float64), atol=0)
    volume = field.voxelise(Grid.centred((6, 5, 8), 2 * PIXEL))
    assert volume.delta[2:4, 1:4, 2:6] == pytest.approx(1.0)
    assert volume.beta[3, 2, 4] == pytest.approx(0.5)


@pytest.mark.parametrize(
    ("matter", "bounds"),
    [
        (Matter.one(1.0, 0.1), (0.0, 1.0)),
        (Matter.one(1.0, 0.1), (0.0, 0.0)),
        (Matter.free(1.0, 0.1), (0.0, 1.0)),
        (Matter.one(1.0, 0.1), (-math.inf, 0.0)),
    ],
)
@pytest.mark.parametrize("log2_size", [4, 12], ids=["hashed", "dense"])
def test_gradients_are_those_of_finite_differences(matter, bounds, log2_size):
    """In float64, along a random direction of each parameter."""
    network = Network(Encoding(levels=2, features=2, coarsest=8.0, finest=3.0, log2_size=log2_size), 8, 1)
    start = smooth(Grid.centred((7, 5, 9), PIXEL), matter, network, upper=bounds[1], lower=bounds[0])
    leaves = {name: p.clone().requires_grad_() for name, p in start.parameters().items()}
    field = start.with_parameters(leaves)
    views = any_pose(1, (5, 7)).refined(2)

    def total() -> torch.Tensor:
        lines = field.project(views).channels / PIXEL
        return (lines * torch.linspace(0.5, 1.5, lines.numel(), dtype=lines.dtype).reshape(lines.shape)).sum()

    total().backward()
    for parameter in leaves.values():
        assert parameter.grad is not None
        way = torch.randn(parameter.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(5))
        slope, step = float((parameter.grad * way).sum()), 1e-6
        with torch.no_grad():
            ahead, back = _ends(parameter, way, step, total)
        assert (ahead - back) / (2 * step) == pytest.approx(slope, rel=1e-4, abs=1e-6)


def _ends(parameter: torch.Tensor, way: torch.Tensor, step: float, total) -> tuple[float, float]:
    parameter.add_(step * way)
    ahead = float(total())
    parameter.sub_(2 * step * way)
    back = float(total())
    parameter.add_(step * way)
    return ahead, back


@pytest.mark.parametrize("log2_size", [4, 12], ids=["hashed", "dense"])
def test_features_are_linear_within_cells_and_continuous_between(log2_size):
    options = Encoding(levels=1, features=3, coarsest=2.0, finest=2.0, log2_size=log2_size)
    encoding = options.build(12.0, torch.Generator().manual_seed(0)).double()
    start = torch.rand(40, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64) * 10
    for axis in range(3):
        corner = start.clone()
        corner[:, axis] = (start[:, axis] / 2).floor() * 2
        step = torch.eye(3, dtype=torch.float64)[axis]
        with torch.no_grad():
            before, at, middle, end = (encoding(corner + t * step) for t in (-1e-9, 0.0, 1.0, 2.0 - 1e-9))
        assert torch.allclose(before[corner[:, axis] > 0], at[corner[:, axis] > 0], atol=1e-11)
        assert torch.allclose(middle, 0.5 * (at + end), atol=1e-11)
        assert float((end - at).abs().max()) > 1e-5


def test_the_mask_only_leaves_out_what_it_covers():
    grid, views = Grid.centred((9, 7, 11), PIXEL), any_pose(2, (11, 13))
    matter = ball(grid, 3 * PIXEL)[0] > 0
    whole, masked = (smooth(grid, ONE, SMALL, mask) for mask in (None, matter))
    assert torch.equal(masked.values(grid), whole.values(grid) * matter)
    parts = [smooth(grid, ONE, SMALL, mask).project(views).channels for mask in (matter, ~matter)]
    assert torch.allclose(parts[0] + parts[1], whole.project(views).channels, atol=1e-20)
    chosen = torch.tensor([3, 40, 41])
    some, every = whole.samples(views, 0, chosen), whole.samples(views, 0)
    kept = torch.isin(every.pixel, chosen)
    assert torch.equal(some.pixel, every.pixel[kept])
    assert torch.equal(some.depth, every.depth[kept])


def test_pruning_keeps_what_is_there():
    grid = Grid.centred((9, 7, 11), PIXEL)
    field = smooth(grid)
    values = field.values(grid)[0]
    level = float(values.median())
    within = torch.arange(11) > 2
    field.prune(level, 1, within)
    mask = field.mask
    assert torch.equal(mask, grown(values > level, 1) & within)
    before = mask.clone()
    field.prune(2.0, 1, within)
    assert torch.equal(mask, before)


def test_fields_are_objects_reproducible_by_seed():
    grid = Grid.centred((9, 7, 11), PIXEL)
    mask = torch.ones(grid.shape, dtype=torch.bool)
    first, same, other = (NeuralField(grid, ONE, SMALL, mask, seed) for seed in (3, 3, 4))
    assert isinstance(first, Object)
    assert first.at(1.0) is first
    assert torch.equal(first.values(grid), same.values(grid))
    assert not torch.equal(first.values(grid), other.values(grid))


CUBE = Grid.centred((3, 3, 3), 1.0)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Encoding("wavelet"), "kind must be one of hash, fourier, octaves"),  # type: ignore[arg-type]
        (lambda: Encoding(levels=0), "levels must be at least 1"),
        (lambda: Encoding(coarsest=1.0, finest=2.0), "finest must lie between"),
        (lambda: Encoding(bandwidth=0.0), "bandwidth must be a positive number"),
        (lambda: Network(hidden=0), "hidden must be at least 1"),
        (lambda: Matter(()), "matter must have a channel at least, but it has none"),
        (lambda: Matter(((1.0, 0.0),) * 3, occupancies=False), "have a channel each, but matter has 3"),  # type: ignore[arg-type]
        (lambda: NeuralField(CUBE, Matter.one(0.0, 0.0), SMALL, torch.ones(3, 3, 3)), "matter with a δ"),
        (lambda: NeuralField(CUBE, ONE, SMALL, torch.ones(3, 3, 3), upper=-1.0), "upper must not be negative"),
        (
            lambda: NeuralField(CUBE, ONE, SMALL, torch.ones(3, 3, 3), lower=-1.0),
            "lower must be 0 or -inf",
        ),
        (
            lambda: NeuralField(CUBE, ONE, SMALL, torch.ones(3, 3, 3), lower=-math.inf),
            "has no upper one",
        ),
        (lambda: NeuralField(CUBE, ONE, SMALL, torch.ones(2, 3, 3)), "mask"),
    ],
)
def test_bad_options_are_refused(make, message):
    with pytest.raises(InputError, match=message):
        make()
