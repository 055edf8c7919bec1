"""Round-ended rods: their line integrals and voxels beside closed forms, wherever they point."""

from __future__ import annotations

import numpy as np
import pytest

from holosplat.checks import InputError
from holosplat.geometry import Grid, Views
from holosplat.matter import DeltaBeta
from holosplat_bench.specimens.rods import Rod, RodScene

PIXEL = 1e-6
MATTER = DeltaBeta(6e-7, 3e-10)
WAYS = {"along": (0, 0, 1), "across": (1, 0, 0), "up": (0, 1, 0), "slanted": (0.48, 0.6, 0.64)}


def rod(way: str, length: float = 18e-6, radius: float = 5e-6) -> Rod:
    middle, half = np.array([2e-6, -1e-6, 3e-6]), 0.5 * length * np.array(WAYS[way])
    return Rod(middle - half, middle + half, radius)


@pytest.mark.parametrize("way", WAYS)
def test_line_integrals_and_voxels_sum_up_to_the_volume(way):
    """On a rectangular, odd-sized detector that is shifted, in views that are not coplanar."""
    one = rod(way)
    rotations = Views.from_angles([0.0, 40.0], (1, 1), PIXEL).rotations
    tilted = np.array([[1, 0, 0], [0, 0.8, -0.6], [0, 0.6, 0.8]]) @ rotations[1]
    views = Views(np.stack([*rotations, tilted]), np.full((3, 2), 1.7e-6), (45, 53), PIXEL)
    _, delta = RodScene((one,), MATTER).project(views)
    assert (delta.sum(dim=(1, 2)) * PIXEL**2).numpy() == pytest.approx(MATTER.delta * one.volume, rel=1e-2, abs=0)
    volume = RodScene((one,), MATTER).voxelise(Grid.of_views(views))
    assert float(volume.delta.sum()) * PIXEL**3 == pytest.approx(MATTER.delta * one.volume, rel=1e-2, abs=0)
    assert volume.delta.max() == pytest.approx(MATTER.delta)


def test_a_cylinder_across_the_beam_has_its_chord():
    """`2 √(r² - d²) / sin` of the angle to the beam, along its whole length; its ends are those of balls."""
    radius, angle = 7e-6, np.deg2rad(50)
    way = np.array([0.0, np.sin(angle), np.cos(angle)]) * 60e-6
    scene = RodScene((Rod(-way, way, radius),), MATTER)
    views = Views.from_angles([0.0], (31, 1001), 2e-8)
    lines = scene.project(views)[1][0].numpy() / MATTER.delta
    x = (np.arange(1001) + 0.5 - 500.5) * 2e-8
    chord = 2 * np.sqrt(np.maximum(radius**2 - x**2, 0)) / np.sin(angle)
    assert np.abs(lines - chord).max() < 2e-2 * chord.max()  # in the last pixel at the edge
    assert np.abs(lines - chord)[:, 200:-200].max() < 5e-6 * chord.max()
    ball = RodScene((Rod(np.zeros(3), np.zeros(3), radius),), MATTER).project(views)[1][0].numpy()
    y = ((np.arange(31) + 0.5 - 15.5) * 2e-8)[:, None]
    sphere = 2 * np.sqrt(np.maximum(radius**2 - x**2 - y**2, 0))
    assert np.abs(ball / MATTER.delta - sphere)[:, 200:-200].max() < 5e-6 * sphere.max()


def test_rods_that_cross_count_once():
    """Two cylinders of equal radius at right angles share Steinmetz's solid, 16 r³/3."""
    r = 5e-6
    cross = RodScene(tuple(rod_through(way, r) for way in ("across", "up")), MATTER)
    views = Views.from_angles([0.0, 30.0], (47, 51), PIXEL)
    expected = sum(one.volume for one in cross.rods) - 16 / 3 * r**3
    _, delta = cross.project(views)
    assert (delta.sum(dim=(1, 2)) * PIXEL**2).numpy() == pytest.approx(MATTER.delta * expected, rel=1e-2, abs=0)


def rod_through(way: str, radius: float) -> Rod:
    half = 14e-6 * np.array(WAYS[way])
    return Rod(-half, half, radius)


def test_the_field_misses_what_reaches_beyond_it():
    views = Views.from_angles([0.0], (21, 41), PIXEL)
    scene = RodScene((rod("up", length=30e-6),), MATTER)
    assert scene.missing_field(views) == pytest.approx(16e-6 + 5e-6 - 10.5e-6)
    low, high = scene.bounds
    assert low == pytest.approx([-3e-6, -21e-6, -2e-6])
    assert high == pytest.approx([7e-6, 19e-6, 8e-6])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Rod(np.zeros(2), np.zeros(3), 1e-6), "start of a rod"),
        (lambda: Rod(np.zeros(3), np.full(3, np.nan), 1e-6), "end of a rod"),
        (lambda: Rod(np.zeros(3), np.zeros(3), 0.0), "radius of a rod"),
        (lambda: RodScene((), MATTER), "at least one"),
    ],
)
def test_bad_requests_are_refused(make, message):
    with pytest.raises(InputError, match=message):
        make()
