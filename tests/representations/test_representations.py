"""Gaussian clouds: units, projections and volumes of one density, gradients, and where clouds start."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch.nn.functional import avg_pool2d, softplus

from holosplat.checks import InputError
from holosplat.geometry import Grid, Views, rotation_y
from holosplat.matter import Matter
from holosplat.projectors.voxels import voxel_line_integrals
from holosplat.representations import GaussianCloud, approximate, at_pitch, cloud_from_volume, freed, random_cloud
from holosplat.representations.gaussians import PARAMETERS, raw_of
from holosplat.volume import Object

PIXEL = 1.5e-6
DELTA, BETA = 7e-7, 2.5e-10
SHAPE = (26, 30)


def a_cloud(channels: int = 1, count: int = 6, seed: int = 0, beta: float = BETA) -> GaussianCloud:
    """Anisotropic Gaussians of 1.5 to 3 pixels, well inside the field."""
    rng = torch.Generator().manual_seed(seed)
    centres = 8 * (torch.rand(count, 3, generator=rng) - 0.5)
    scales = 1.5 + 1.5 * torch.rand(count, 3, generator=rng)
    amplitudes = 0.2 + torch.rand(count, channels, generator=rng)
    quaternions = torch.randn(count, 4, generator=rng)
    matter = Matter.one(DELTA, beta) if channels == 1 else Matter.free(DELTA, beta)
    return GaussianCloud((centres, scales.log(), quaternions, raw_of(amplitudes)), PIXEL, matter)


def some_views(shape: tuple[int, int] = SHAPE) -> Views:
    """Two tomographic views and two of any orientation, each with its own detector shift."""
    rotations = np.concatenate([rotation_y([0, 50]), Rotation.random(2, random_state=1).as_matrix()])
    shifts = PIXEL * np.array([[0, 0], [0.7, -0.4], [-1.2, 0.3], [0.1, 0.9]])
    return Views(rotations, shifts, shape, PIXEL)


def largest_difference(found: torch.Tensor, wanted: torch.Tensor) -> float:
    """max |found - wanted| / max |wanted|."""
    return float((found - wanted).abs().max() / wanted.abs().max())


def in_float64(cloud: GaussianCloud) -> GaussianCloud:
    """The cloud in double precision, drawn by the reference backend."""
    twin = cloud.replaced([p.detach().double() for p in cloud.parameters().values()])
    twin.backend = "reference"
    return twin


# --- projections and volumes --------------------------------------------------------------------------------


def test_a_cloud_is_an_object_that_does_not_move():
    cloud = a_cloud()
    assert isinstance(cloud, Object)
    assert cloud.at(3.0) is cloud
    assert len(cloud) == 6
    assert all(getattr(cloud, name) is p for name, p in cloud.parameters().items())
    assert tuple(cloud.parameters()) == PARAMETERS


@pytest.mark.parametrize("channels", [1, 2])
def test_projections_are_the_line_integrals_of_the_clouds_own_density(channels):
    cloud, views = a_cloud(channels), some_views()
    grid = Grid.centred((120, 120, 120), PIXEL / 4)
    with torch.no_grad():
        density = cloud.density(grid)
        lines = voxel_line_integrals(density, grid, views, rays=3)
        B, D = cloud.project(views)
    assert B.shape == D.shape == (4, *SHAPE)
    assert largest_difference(D, lines[:, 0] * DELTA) < 0.01
    assert largest_difference(B, lines[:, -1] * BETA) < 0.01


def test_line_integrals_are_in_metres():
    """One round Gaussian: the peak is a·δ·√(2π)·σ, and the sum over pixels a·δ·(2π)^{3/2}·σ³."""
    sigma, amplitude = 3.0, 0.8
    parameters = [torch.zeros(1, 3), torch.full((1, 3), np.log(sigma)), torch.tensor([[1.0, 0, 0, 0]])]
    cloud = GaussianCloud([*parameters, raw_of(torch.tensor([[amplitude]]))], PIXEL, Matter.one(DELTA, BETA))
    B, D = cloud.project(Views.evenly_spaced(3, (41, 41), PIXEL))
    peak = amplitude * DELTA * np.sqrt(2 * np.pi) * sigma * PIXEL
    mass = amplitude * DELTA * (2 * np.pi) ** 1.5 * (sigma * PIXEL) ** 3
    np.testing.assert_allclose(D[:, 20, 20], peak, rtol=0.02)
    np.testing.assert_allclose(D.sum((1, 2)) * PIXEL**2, mass, rtol=2e-3)
    np.testing.assert_allclose(B, D * BETA / DELTA, rtol=1e-5, atol=0)


def test_the_unit_of_length_changes_nothing_but_the_numbers():
    cloud, views = a_cloud(), some_views()
    centres, log_scales, quaternions, raw = cloud.parameters().values()
    other = GaussianCloud((centres / 2.5, log_scales - np.log(2.5), quaternions, raw), 2.5 * PIXEL, cloud.matter)
    grid = Grid.centred((20, 22, 24), 1.1 * PIXEL)
    for found, wanted in zip(other.project(views), cloud.project(views)):
        assert largest_difference(found, wanted) < 1e-4
    assert largest_difference(other.density(grid), cloud.density(grid)) < 1e-4
    np.testing.assert_allclose(other.masses() * 2.5**3, cloud.masses(), rtol=1e-5)


def test_a_finer_raster_shows_the_same_lines():
    cloud, views = a_cloud(), some_views()
    _, coarse = cloud.project(views)
    _, fine = cloud.project(views.refined(3))
    assert largest_difference(avg_pool2d(fine[None], 3)[0], coarse) < 3e-3


def test_a_padded_raster_shows_the_same_lines_in_its_middle():
    cloud, views = a_cloud(), some_views()
    _, plain = cloud.project(views)
    _, padded = cloud.project(views.padded((3, 5)))
    assert largest_difference(padded[:, 3:-3, 5:-5], plain) < 1e-5


def test_a_detector_shift_moves_the_picture_the_other_way():
    cloud, views = a_cloud(), Views.evenly_spaced(2, SHAPE, PIXEL)
    _, plain = cloud.project(views)
    _, shifted = cloud.project(replace(views, shifts=np.full((2, 2), 1.0) * PIXEL * [2, 3]))
    assert largest_difference(shifted[:, :-3, :-2], plain[:, 3:, 2:]) < 1e-5


def test_beta_of_either_sign():
    """Cells in plasma absorb less than what they displace."""
    B, D = a_cloud(beta=-BETA).project(some_views())
    assert float(D.max()) > 0 > float(B.min())
    assert float(B.max()) <= 0
    np.testing.assert_allclose(B, -D * BETA / DELTA, rtol=1e-5, atol=0)


def test_two_channels_are_two_clouds_in_the_same_places():
    both, views, grid = a_cloud(channels=2), some_views(), Grid.centred((9, 10, 11), PIXEL)
    places = (both.centres, both.log_scales, both.quaternions)
    one = Matter.one(DELTA, BETA)
    of_delta, of_beta = (both.replaced((*places, both.raw_amplitudes[:, c : c + 1]), one) for c in (0, 1))
    assert of_delta.matter.single
    assert not both.matter.single
    B, D = both.project(views)
    np.testing.assert_allclose(D, of_delta.project(views)[1], rtol=1e-5, atol=1e-14)
    np.testing.assert_allclose(B, of_beta.project(views)[0], rtol=1e-5, atol=1e-17)
    volume = both.voxelise(grid)
    np.testing.assert_allclose(volume.delta, of_delta.voxelise(grid).delta, rtol=1e-5, atol=1e-13)
    np.testing.assert_allclose(volume.beta, of_beta.voxelise(grid).beta, rtol=1e-5, atol=1e-16)


def test_a_volume_is_density_times_material():
    cloud, grid = a_cloud(beta=-BETA), Grid.centred((9, 10, 11), 1.3 * PIXEL)
    volume, density = cloud.voxelise(grid), cloud.density(grid)
    assert volume.grid == grid
    np.testing.assert_allclose(volume.delta, density[0] * DELTA, rtol=1e-6, atol=0)
    np.testing.assert_allclose(volume.beta, density[0] * -BETA, rtol=1e-6, atol=0)


def test_a_block_of_the_grid_is_a_block_of_the_volume():
    cloud, grid = a_cloud(), Grid.centred((20, 24, 22), PIXEL)
    start, shape = (3, 7, 5), (10, 9, 13)
    whole = cloud.density(grid)[:, 3:13, 7:16, 5:18]
    assert largest_difference(cloud.density(grid.block(start, shape)), whole) < 1e-5


def test_a_grid_anywhere_holds_the_density_of_that_place():
    """Density at voxel centres of a shifted grid, against the sum of Gaussians written out."""
    cloud = a_cloud()
    grid = Grid((5, 6, 7), (0.5 * PIXEL,) * 3, (1.3 * PIXEL, -2.2 * PIXEL, 0.4 * PIXEL))
    x, y, z = grid.axes()
    points = np.stack(np.meshgrid(z, y, x, indexing="ij")[::-1], axis=-1) / PIXEL
    wanted = np.zeros(grid.shape)
    quaternions = cloud.quaternions.numpy().astype(float)
    turns = Rotation.from_quat(np.roll(quaternions, -1, axis=1)).as_matrix()
    for c, s, turn, a in zip(cloud.centres.numpy(), cloud.scales.numpy(), turns, cloud.amplitudes.numpy()):
        local = (points - c) @ turn / s
        wanted += a[0] * np.exp(-0.5 * (local**2).sum(-1))
    assert largest_difference(cloud.density(grid)[0], torch.from_numpy(wanted)) < 0.03


def test_flat_voxels_are_refused():
    with pytest.raises(InputError, match="cubic"):
        a_cloud().density(Grid((4, 4, 4), (PIXEL, PIXEL, 2 * PIXEL), (0, 0, 0)))


@pytest.mark.parametrize("channels", [1, 2])
def test_masses_are_the_integral_of_the_density(channels):
    cloud, grid = a_cloud(channels), Grid.centred((120, 120, 120), PIXEL / 3)
    integral = cloud.density(grid).sum((1, 2, 3)) * (1 / 3) ** 3
    assert cloud.masses().shape == (6, channels)
    np.testing.assert_allclose(integral, cloud.masses().sum(0), rtol=3e-3)


# --- parameters and gradients -------------------------------------------------------------------------------


def test_raw_amplitudes_and_amplitudes_are_inverse():
    amplitudes = torch.logspace(-5, 2, 60)
    np.testing.assert_allclose(softplus(raw_of(amplitudes)), amplitudes, rtol=1e-5)
    doubles = torch.logspace(-5, 2, 60, dtype=torch.float64)
    np.testing.assert_allclose(softplus(raw_of(doubles)), doubles, rtol=1e-6)
    assert bool(torch.isfinite(raw_of(torch.zeros(3))).all())


@pytest.mark.parametrize("channels", [1, 2])
@pytest.mark.parametrize("act", ["project", "density"])
def test_gradients_reach_all_parameters_and_match_the_reference_in_float64(channels, act):
    def gradients(cloud: GaussianCloud) -> tuple[torch.Tensor, ...]:
        leaves = [p.clone().requires_grad_() for p in cloud.parameters().values()]
        used = cloud.replaced(leaves)
        if act == "project":
            B, D = used.project(some_views())
            outputs = torch.stack([D / (DELTA * PIXEL), B / (BETA * PIXEL)])
        else:
            outputs = used.density(Grid((12, 10, 14), (PIXEL,) * 3, (-6 * PIXEL, -4 * PIXEL, -7 * PIXEL)))
        weights = torch.sin(torch.arange(outputs.numel(), dtype=outputs.dtype)).reshape(outputs.shape)
        return torch.autograd.grad((outputs * weights).sum(), leaves)

    cloud = a_cloud(channels)
    found, wanted = gradients(cloud), gradients(in_float64(cloud))
    for name, a, b in zip(PARAMETERS, found, wanted):
        assert float(b.abs().max()) > 0.01, name
        assert largest_difference(a.double(), b) < 2e-4, name


def test_copies_keep_units_and_backend():
    cloud = a_cloud(beta=-BETA)
    cloud.backend = "reference"
    leaves = [p.clone().requires_grad_() for p in cloud.parameters().values()]
    for copy in (cloud.replaced(leaves), cloud.replaced(leaves).detached()):
        assert (copy.unit_length, copy.matter, copy.backend) == (PIXEL, Matter.one(DELTA, -BETA), "reference")
    detached = cloud.replaced(leaves).detached()
    assert not any(p.requires_grad for p in detached.parameters().values())
    with torch.no_grad():
        leaves[0].add_(1.0)
    assert torch.equal(detached.centres, cloud.centres)


@pytest.mark.parametrize("which", range(4))
def test_parameters_of_the_wrong_shape_are_refused(which):
    parameters = list(a_cloud().parameters().values())
    parameters[which] = parameters[which][:, :0] if which == 3 else parameters[which][:-1]
    with pytest.raises(InputError, match="shapes"):
        GaussianCloud(parameters, PIXEL, Matter.one(DELTA, BETA))


# --- where clouds start -------------------------------------------------------------------------------------


def a_body(shape: tuple[int, int, int] = (17, 20, 22)) -> torch.Tensor:
    """An off-centre box of matter, with a denser corner."""
    body = torch.zeros(shape)
    body[4:13, 3:15, 6:18] = 1.0
    body[4:8, 3:9, 6:10] = 1.5
    return body


@pytest.mark.parametrize("spacing", [1.0, 2.2, 3.0])
def test_a_cloud_from_a_volume_has_its_mass_and_its_centre(spacing):
    """On grids that are off the origin, and with spacings that do not divide the volume."""
    voxel = 0.5 * PIXEL
    grid = Grid((17, 20, 22), (voxel,) * 3, (-3e-6, 1e-6, 5e-6))
    body = a_body()
    cloud = cloud_from_volume(body, grid, (DELTA, -BETA), spacing * voxel, PIXEL)
    masses = cloud.masses()[:, 0] * PIXEL**3
    assert float(masses.sum()) == pytest.approx(float(body.sum()) * voxel**3, rel=1e-4, abs=0)
    z, y, x = torch.meshgrid(*(torch.from_numpy(a) for a in grid.axes()[::-1]), indexing="ij")
    wanted = [float((axis * body).sum() / body.sum()) for axis in (x, y, z)]
    found = (cloud.centres * PIXEL * masses[:, None]).sum(0) / masses.sum()
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-3 * voxel)
    assert (cloud.unit_length, cloud.matter) == (PIXEL, Matter.one(DELTA, -BETA))


def test_spacing_is_the_distance_between_gaussians():
    voxel = PIXEL / 2
    grid = Grid.centred((12, 12, 12), voxel)
    for edge in (1, 2, 3):
        cloud = cloud_from_volume(torch.ones(12, 12, 12), grid, (DELTA, BETA), edge * voxel, PIXEL)
        assert len(cloud) == (12 // edge) ** 3
        np.testing.assert_allclose(cloud.scales, 0.25 * edge, rtol=1e-5)
        x = torch.unique((cloud.centres[:, 0] * 1e3).round() / 1e3)
        np.testing.assert_allclose(x.diff(), 0.5 * edge, atol=2e-3)


@pytest.mark.parametrize("edge", [1, 2, 4])
def test_full_blocks_make_a_flat_density(edge):
    """Ripple (rms) below 3 % on a raster much finer than the blocks, around the right level."""
    grid = Grid.centred((8 * edge,) * 3, PIXEL)
    cloud = cloud_from_volume(torch.ones(grid.shape), grid, (DELTA, BETA), edge * PIXEL, PIXEL)
    inside = cloud.density(Grid.centred((32, 32, 32), edge * PIXEL / 16))
    assert float(inside.mean()) == pytest.approx(1, abs=0.01)
    assert float(inside.std()) < 0.03
    assert float((inside - 1).abs().max()) < 0.05


def test_nearly_empty_blocks_are_left_out_and_negative_matter_counts_as_none():
    grid, body = Grid.centred((8, 8, 8), PIXEL), torch.full((8, 8, 8), -1.0)
    body[:2, :2, :2] = 1.0
    body[1, 0, 0] = -5.0
    body[4:6, 4:6, 4:6] = 0.04
    cloud = cloud_from_volume(body, grid, (DELTA, BETA), 2 * PIXEL, PIXEL)
    assert len(cloud) == 1
    assert float(cloud.masses()) == pytest.approx(7, rel=1e-5)
    np.testing.assert_allclose(cloud.centres, [[4 / 7 - 3.5, 4 / 7 - 3.5, 3 / 7 - 3.5]], atol=1e-5)


def test_a_coarse_volume_is_refined_where_it_is():
    """Onto voxels of the pitch, with its mass and its place; a volume that is fine enough stays as it is."""
    coarse, body = Grid((9, 8, 7), (3 * PIXEL,) * 3, (-2e-6, 4e-6, 1e-5)), torch.zeros(9, 8, 7)
    body[3:6, 2:5, 2:6] = 1.0
    volume, grid = at_pitch(body, coarse, PIXEL)
    assert volume.shape == grid.shape == (27, 24, 21)
    np.testing.assert_allclose(grid.voxel_size, PIXEL)
    for a, b in zip(coarse.axes(), grid.axes()):
        assert a.mean() == pytest.approx(b.mean(), abs=1e-12)
    assert float(volume.sum()) == pytest.approx(27 * float(body.sum()), rel=1e-3)
    for dimension, axes in enumerate(zip(coarse.axes()[::-1], grid.axes()[::-1])):
        others = tuple({0, 1, 2} - {dimension})
        found = [(torch.from_numpy(a) * v.sum(others)).sum() / v.sum() for a, v in zip(axes, (body, volume))]
        assert float(found[0]) == pytest.approx(float(found[1]), abs=1e-3 * PIXEL)
    same, unchanged = at_pitch(body, coarse, 4 * PIXEL)
    assert same is body
    assert unchanged is coarse


def test_an_empty_volume_is_refused():
    with pytest.raises(InputError, match="no matter"):
        cloud_from_volume(torch.zeros(6, 6, 6), Grid.centred((6, 6, 6), PIXEL), (DELTA, BETA), PIXEL, PIXEL)


def test_approximating_a_volume_lowers_the_error():
    grid, stages = Grid((17, 20, 22), (PIXEL,) * 3, (-8 * PIXEL, -9 * PIXEL, -11 * PIXEL)), []
    body = a_body()
    start = cloud_from_volume(body, grid, (DELTA, -BETA), 2 * PIXEL, PIXEL)
    before = [p.clone() for p in start.parameters().values()]
    better = approximate(start, body, grid, 25, lambda stage, fraction: stages.append(fraction))
    errors = [float((c.density(grid)[0] - body).norm() / body.norm()) for c in (start, better)]
    assert errors[1] < 0.75 * errors[0]
    assert all(torch.equal(p, q) for p, q in zip(start.parameters().values(), before))
    assert not any(p.requires_grad for p in better.parameters().values())
    assert better.matter == Matter.one(DELTA, -BETA)
    assert len(stages) == 25
    assert stages == sorted(stages)
    assert 0 <= stages[0] < stages[-1] <= 1


@pytest.mark.parametrize("channels", [1, 2])
def test_a_random_cloud_is_a_ball_of_the_asked_mass(channels):
    views, thickness = Views.evenly_spaced(4, (40, 60), PIXEL), 3e-6
    matter = Matter.one(DELTA, BETA) if channels == 1 else Matter.free(DELTA, BETA)
    cloud = random_cloud(4000, views, matter, thickness, seed=3)
    radius = 0.5 * 40
    distance = cloud.centres.norm(dim=1)
    assert len(cloud) == 4000
    assert float(distance.max()) <= radius
    assert float(((distance / radius) ** 3).mean()) == pytest.approx(0.5, abs=0.02)  # uniform in volume
    np.testing.assert_allclose(cloud.centres.mean(0), 0, atol=0.5)
    slab = np.pi * (radius * PIXEL) ** 2 * thickness
    np.testing.assert_allclose(cloud.masses().sum(0) * PIXEL**3, slab, rtol=1e-3)
    assert cloud.raw_amplitudes.shape == (4000, channels)
    neighbour = (4 / 3 * np.pi * radius**3 / 4000) ** (1 / 3)
    np.testing.assert_allclose(2 * cloud.scales, neighbour, rtol=0.01)


def test_a_random_cloud_is_reproducible_by_its_seed():
    views = Views.evenly_spaced(4, (40, 60), PIXEL)
    first, same, other = (random_cloud(50, views, Matter.one(DELTA, BETA), 1e-6, seed) for seed in (5, 5, 6))
    assert all(torch.equal(p, same.parameters()[name]) for name, p in first.parameters().items())
    assert not torch.equal(first.centres, other.centres)
    with pytest.raises(InputError, match="number of Gaussians"):
        random_cloud(0, views, Matter.one(DELTA, BETA), 1e-6, 0)


def test_a_freed_cloud_looks_the_same_but_has_two_amplitudes():
    cloud, views = a_cloud(), some_views()
    free = freed(cloud)
    assert free.matter == Matter.free(DELTA, BETA)
    for found, wanted in zip(free.project(views), cloud.project(views)):
        np.testing.assert_allclose(found, wanted, rtol=1e-6, atol=0)
    free.centres.add_(1.0)
    free.raw_amplitudes.add_(1.0)
    assert all(torch.equal(p, a_cloud().parameters()[name]) for name, p in cloud.parameters().items())
