"""What a body and its twin have in common in two beams."""

from __future__ import annotations

import numpy as np
import pytest

import holosplat as hs
from holosplat.bodies.poses import distance, twin_map, twin_of, two_beams
from holosplat.geometry import rotation_y

PIXEL, SHAPE = 1e-6, (29, 35)
ACROSS = rotation_y(np.array([0.0, 90.0]))[:, 2]
TIMES = 1e-4 * np.arange(4)


@pytest.mark.parametrize("angle", [90.0, 23.8])
def test_twins_have_the_same_shadows_moments_and_volume(angle):
    beams = rotation_y(np.array([0.0, angle]))
    draws = np.random.default_rng(3).normal(size=(5, 3, 3))
    for second in draws @ draws.transpose(0, 2, 1):
        matrix = twin_map(second, beams[:, 2])
        other = matrix @ second @ matrix.T
        assert np.linalg.det(matrix) == pytest.approx(1)
        assert np.abs(other - second).max() > 1e-2
        for view in beams[:, :2]:
            np.testing.assert_allclose(view @ other @ view.T, view @ second @ view.T, atol=1e-9)
        back = twin_map(other, beams[:, 2])
        np.testing.assert_allclose(back @ other @ back.T, second, atol=1e-9)


def test_what_is_alike_on_both_sides_of_a_beam_is_its_own_twin():
    np.testing.assert_allclose(twin_map(np.diag([1.0, 2.0, 3.0]), ACROSS), np.eye(3), atol=1e-12)


def test_two_beams_are_two_directions_of_either_sense():
    def views(*angles: float) -> hs.Views:
        return hs.Views.from_angles(np.array(angles), SHAPE, PIXEL)

    assert two_beams(views(0.0, 30.0, 48.0)) is None
    assert two_beams(views(0.0, 180.0)) is None
    found = two_beams(views(0.0, 90.0, 180.0, 0.0, 270.0))
    assert found is not None
    np.testing.assert_allclose(np.abs(found), np.abs(ACROSS), atol=1e-12)


def test_the_distance_of_twins():
    """Of long rods along the diagonal of two beams: the twin lies along the other one, at √2 of the rod's extent."""
    along, across = np.array([1.0, 0, 1]) / 2**0.5, np.array([1.0, 0, -1]) / 2**0.5
    rod = 1e-4 * np.eye(3) + np.outer(along, along)
    twin = twin_of(rod, ACROSS)
    assert distance(rod, ACROSS) == pytest.approx(2**0.5, rel=0.02)
    np.testing.assert_allclose(twin, 1e-4 * np.eye(3) + np.outer(across, across), atol=1e-9)
    assert distance(np.eye(3), ACROSS) == pytest.approx(0, abs=1e-7)
