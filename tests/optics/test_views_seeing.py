"""How many views show a voxel with its first fringe."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from holosplat.geometry import Grid, Views
from holosplat.optics.sampling import fringes, views_seeing
from holosplat.scan import Exposures

GRID = Grid((7, 9, 12), (2e-6, 3e-6, 2.5e-6), (-11e-6, -14e-6, -13e-6))
SHAPE, PIXEL = (13, 17), 1.3e-6


def by_points(exposures: Exposures) -> np.ndarray:
    """The same, of every voxel by itself."""
    views, margin, found = exposures.views, fringes(exposures), np.zeros(GRID.shape, dtype=int)
    x, y, z = GRID.axes()
    for place in np.ndindex(GRID.shape):
        point = np.array([x[place[2]], y[place[1]], z[place[0]]])
        for v in range(len(views)):
            column, row = (views.rotations[v] @ point)[:2] - views.shifts[v]
            width, height = views.pixel_sizes[v] * np.array(SHAPE[::-1]) / 2
            found[place] += abs(column) <= width - margin[v] and abs(row) <= height - margin[v]
    return found


def test_any_poses_are_counted():
    """Tilted beams, shifted detectors, pixels and distances of their own."""
    rotations = Rotation.random(5, random_state=1).as_matrix()
    pixels = PIXEL * np.array([1.0, 1.0, 1.5, 2.0, 1.0])
    views = Views.from_rotations(rotations, SHAPE, pixels)
    views = Views(views.rotations, views.shifts + 3e-6 * np.arange(10).reshape(5, 2) / 9, SHAPE, PIXEL, views.scales)
    exposures = Exposures.of(views, 20.0, np.array([0.0, 0.05, 0.1, 0.02, 0.3]))
    found = views_seeing(exposures, GRID)
    assert found.dtype == np.uint16
    np.testing.assert_array_equal(found, by_points(exposures))
    assert 0 < found.max() <= 5


def test_views_about_an_axis_are_counted_column_by_column():
    views = Views.from_angles([0.0, 20.0, 75.0, 140.0], SHAPE, PIXEL)
    views = Views(views.rotations, np.tile([2e-6, -1e-6], (4, 1)), SHAPE, PIXEL)
    assert views.shares_axis
    exposures = Exposures.of(views, 11.0, 0.1)
    np.testing.assert_array_equal(views_seeing(exposures, GRID), by_points(exposures))


def test_a_field_loses_a_first_fringe_at_each_side():
    """In contact there is none; at a distance it is √(λz) wide."""
    views = Views.evenly_spaced(6, (21, 31), 1e-6)
    grid = Grid.of_views(views)
    contact, away = (views_seeing(Exposures.of(views, 20.0, z), grid) for z in (0.0, 0.1))
    x, y, z = grid.axes()
    inside = np.hypot(x, z[:, None]) < 15.4e-6
    assert (contact[:, :, :] == 6).all(axis=1)[inside].all()
    rows = (away == 6).any(axis=(0, 2))
    width = fringes(Exposures.of(views, 20.0, 0.1))[0]
    np.testing.assert_array_equal(rows, np.abs(y) <= 10.5e-6 - width)
    assert 0 < rows.sum() < 21


def test_in_cones_what_is_nearer_the_source_leaves_the_frame_sooner():
    """On the beam's axis all depths are seen; half a field beside it, only what lies behind the axis."""
    views = replace(Views.from_angles([0.0], (9, 11), 1e-6), sources=np.array([20e-6]))
    grid = Grid((13, 3, 13), (1e-6,) * 3, (-6e-6, -1e-6, -6e-6))
    seen = views_seeing(Exposures.of(views, 20.0, 0.0), grid)
    z, y, x = np.meshgrid(*(np.arange(n) - (n - 1) / 2 for n in grid.shape), indexing="ij")
    assert np.array_equal(seen > 0, (np.abs(x) * 20 / (20 + z) <= 5.5) & (np.abs(y) * 20 / (20 + z) <= 4.5))
    assert seen[-1, 1, 0] > seen[0, 1, 0] == 0
