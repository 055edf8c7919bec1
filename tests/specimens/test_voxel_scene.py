"""Volumes as specimens: mass, lines through smooth matter, means on other grids, the field that they need."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from holosplat.checks import InputError
from holosplat.geometry import Grid, Views, rotation_tilted
from holosplat.matter import DeltaBeta
from holosplat.mesh import TriangleMesh
from holosplat.specimens.continuous import Bump, ContinuousScene, ellipsoid
from holosplat.specimens.red_cells import icosphere
from holosplat.specimens.scene import MeshScene, VoxelScene
from holosplat.volume import Volume

MATTER = DeltaBeta(2e-7, 1e-10)
GRID = Grid((41, 33, 45), (1e-6, 1e-6, 1e-6), (-21e-6, -17e-6, -19e-6))
"""Odd, unequal counts, off the middle."""


def smooth() -> ContinuousScene:
    return ContinuousScene((ellipsoid((1e-6, -1e-6, 0.5e-6), (15e-6, 11e-6, 13e-6), Bump(3), MATTER),))


def near(value, rel):
    return pytest.approx(value, rel=rel, abs=0)


def test_lines_of_smooth_matter_are_those_of_the_function():
    """Sampled on its grid and interpolated: the error is that of trilinear interpolation, of second order."""
    views = Views(rotation_tilted([0.0, 35.0], [0.0, 15.0]), np.zeros((2, 2)), (29, 39), 1.2e-6)
    exact = smooth().project(views)[1].numpy()
    errors = []
    for refine in (1, 2):
        found = VoxelScene(smooth().voxelise(GRID.divided((refine, refine, refine)))).project(views)
        assert found.materials == (pytest.approx((2e-7 * 0.999, 1e-10 * 0.999), rel=0.02),)
        errors.append(np.abs(found[1].numpy() - exact).max() / exact.max())
    assert errors[0] < 0.02
    assert errors[1] < 0.4 * errors[0]


def test_mass_is_kept_and_other_grids_have_means():
    volume = smooth().voxelise(GRID)
    scene = VoxelScene(volume)
    mass = volume.delta.sum(dtype=float) * 1e-18
    views = Views.from_angles([0.0, 40.0, 90.0], (61, 67), 1e-6)
    assert scene.project(views)[1].sum((1, 2)).numpy() * 1e-12 == near(np.full(3, mass), 2e-3)
    coarse = scene.voxelise(Grid.centred((17, 14, 18), 3e-6))
    assert coarse.delta.sum(dtype=float) * 27e-18 == near(mass, 2e-3)
    assert coarse.beta == near(coarse.delta / 2000, 1e-4) or np.allclose(coarse.beta, coarse.delta / 2000, atol=1e-16)
    exact = smooth().voxelise(coarse.grid).delta
    assert np.linalg.norm(coarse.delta - exact) < 0.03 * np.linalg.norm(exact)


def test_delta_and_beta_of_their_own_are_two_channels():
    rng = np.random.default_rng(0)
    delta, beta = (rng.uniform(0, 1, GRID.shape).astype(np.float32) for _ in range(2))
    lines = VoxelScene(Volume(1e-7 * delta, 1e-10 * beta, GRID)).project(Views.evenly_spaced(1, (9, 11), 2e-6))
    assert len(lines.materials) == 2
    assert lines[1].mean() / lines[0].mean() == near(1000, 0.05)
    absorbing = VoxelScene(Volume(0 * delta, 1e-10 * beta, GRID)).project(Views.evenly_spaced(1, (9, 11), 2e-6))
    assert absorbing[0].mean() > 0
    assert not absorbing[1].any()


def test_the_field_that_a_volume_needs():
    delta = np.zeros(GRID.shape, np.float32)
    delta[20, 5, 7] = 1e-7
    scene = VoxelScene(Volume(delta, 0 * delta, GRID))
    low, high = scene.bounds
    assert 0.5 * (low + high) == pytest.approx((-14e-6, -12e-6, 1e-6), abs=1e-12)
    assert scene.missing_field(Views.evenly_spaced(1, (25, 29), 1e-6)) == pytest.approx(0, abs=1e-12)
    assert scene.missing_field(Views.evenly_spaced(1, (25, 27), 1e-6)) == pytest.approx(1e-6)
    with pytest.raises(InputError, match="zero everywhere"):
        VoxelScene(Volume(0 * delta, 0 * delta, GRID))


def test_scenes_in_cones_lie_where_the_rays_meet_them():
    """A ball before the axis, beside the middle: its shadow, and how far it reaches beyond the frame."""
    vertices, faces = icosphere(3)
    mesh = TriangleMesh(1e-6 * (3 * vertices + np.array([3.0, -2.0, -6.0])), faces)
    views = replace(Views.from_angles([0.0, 90.0], (25, 31), 1e-6), sources=np.array([30e-6, 40e-6]))
    exact = MeshScene.of_one_material([mesh], DeltaBeta(1e-6, 1e-9))
    lines = exact.project(views)[1].numpy()
    voxels = VoxelScene(exact.voxelise(Grid.centred((25, 25, 25), 1e-6)))
    assert np.linalg.norm(voxels.project(views)[1].numpy() - lines) < 0.1 * np.linalg.norm(lines)
    x = 1e-6 * (np.arange(31) - 15)
    assert (lines[0].sum(0) * x).sum() / lines[0].sum() == pytest.approx(3e-6 * 30 / 24, rel=0.05)
    nearest = mesh.vertices[:, :2] / (1 + mesh.vertices[:, 2:] / 30e-6)
    beyond = (np.abs(nearest) - 0.5e-6 * np.array([31, 25])).max()
    assert exact.missing_field(views[[0]]) == pytest.approx(beyond, rel=1e-9)
