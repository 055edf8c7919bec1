"""Numbers by rows of beams in one plane: rows agree where they are right, and what is not told is as planned."""

from __future__ import annotations

import numpy as np
import pytest

from helpers.misaligned_balls import SHAPE
from helpers.moving_balls import beams, thickness
from helpers.row_images import gaussians, placed
from holosplat.align.derivatives import FACTOR as NUMBERS
from holosplat.align.derivatives import RowInformation, in_pixels
from holosplat.align.initial_geometry import ANGLE, Images, geometry_from_rows
from holosplat.align.row_sums import COUNT, FACTOR, RETRIEVED, RowPrior, by_rows, plane_angles
from holosplat.geometry import Views

EXPECTED = np.array([2.0, 2.0, *np.deg2rad([1.0, 1.0, 1.0])])
THREE, TWO = (0.0, 30.0, 48.0), (0.0, 23.8)
ONCE = np.zeros(1)


def left(views: Views, true: np.ndarray, said: np.ndarray) -> float:
    """Rms that rows of images with `true` numbers [V, 6] have against being of one object at the numbers `said`."""
    images = gaussians(placed(true[:, :FACTOR], views)) * np.exp(true[:, FACTOR])[:, None, None]
    begin = np.stack([said, np.zeros_like(said)])
    found = by_rows(images[None], views, RowPrior(np.zeros((len(views), 5)), np.zeros(5), begin), ONCE)
    np.testing.assert_array_equal(found.numbers, said)
    return float(np.sqrt(np.mean(found.after**2)))


@pytest.mark.parametrize("number", range(COUNT))
def test_rows_agree_at_the_right_number(number):
    views, true = in_pixels(beams(THREE).views), np.zeros((3, COUNT))
    true[1, number] = 0.5 if number < 2 else 0.02
    right, none, wrong = (left(views, true, factor * true) for factor in (1, 0, -1))
    assert right < 0.3 * none
    assert none < 0.7 * wrong


def test_factors_of_masses_are_found_beside_their_mean():
    views, wanted = in_pixels(beams(THREE).views), np.array([0.04, -0.03, -0.01])
    images = gaussians(views) * np.exp(wanted)[:, None, None]
    found = by_rows(images[None], views, RowPrior.of(EXPECTED * [1, 1, 1, 0, 1], 3), ONCE)
    np.testing.assert_allclose(found.numbers[:, FACTOR], wanted, atol=2e-3)


def test_what_rows_do_not_tell_goes_to_what_is_expected():
    """The angle between two beams, wherever it begins."""
    views, begin = in_pixels(beams(TWO).views), np.zeros((2, 2, COUNT))
    begin[0, :, ANGLE] = 0.01, -0.01
    found = by_rows(gaussians(views)[None], views, RowPrior(np.tile(EXPECTED, (2, 1)), np.zeros(5), begin), ONCE)
    assert abs(np.diff(found.numbers[:, ANGLE])[0]) < 1e-3


def test_turns_and_drifts_are_free_after_shifts():
    prior = RowPrior(np.stack([EXPECTED, 0 * EXPECTED]), 0.1 * EXPECTED, np.zeros((2, 2, COUNT)))
    first, then = prior.deviations(True), prior.deviations(False)
    np.testing.assert_array_equal(first[0, 0], [2, 2, 0, 0, 0, RETRIEVED])
    np.testing.assert_array_equal(then[0, 0], [*EXPECTED, RETRIEVED])
    np.testing.assert_array_equal(then[1, 0], [*(0.1 * EXPECTED), 0])
    assert not first[1].any()
    assert not then[:, 1].any()


def test_pixels_of_two_sizes_have_no_rows_in_common():
    views = Views.from_angles([0, 30], SHAPE, 1.0)
    two = Views.of_pixels(views.rotations, views.shifts, SHAPE, np.array([1.0, 1.1]))
    assert plane_angles(views) is not None
    assert plane_angles(two) is None


def test_an_angle_that_is_held_neither_moves_nor_drifts():
    """Its error is what was expected; of the others frames tell more."""
    planned, when = in_pixels(beams(TWO).views), np.array([-1.0, 1.0])
    values = np.stack([thickness(beams(TWO).views, t).double().numpy() for t in when])
    images = Images(values, planned, np.zeros(2, dtype=bool), when)
    found = geometry_from_rows(images, EXPECTED, 0.1 * EXPECTED, few=True)
    assert found is not None
    assert not found.numbers[:, ANGLE].any()
    assert not found.rates[:, ANGLE].any()
    assert found.rates[:, 1].any()
    np.testing.assert_array_equal(found.errors[:, ANGLE], EXPECTED[ANGLE])
    assert (found.errors[:, 1] < 0.2 * EXPECTED[1]).all()


HEIGHTS = np.array([0.0, 1.0, 0.0, 0.0, 0.0])
"""Shifts y alone are uncertain."""


def information(of_height: float, of_both: float, of_factor: float) -> np.ndarray:
    """[12, 12] of two views, the same of each: of shift y, of the factor, and of both together."""
    one = np.zeros((COUNT, COUNT))
    one[1, 1], one[FACTOR, FACTOR], one[1, FACTOR], one[FACTOR, 1] = of_height, of_factor, of_both, of_both
    return np.kron(np.eye(2), one)


def test_errors_are_those_of_the_difference_with_factors_unknown():
    """Of heights of two views only the difference is told: `1 + a - b² / (c + 1/σ²)` of it, by hand."""
    told = RowInformation.of(information(50.0, 100.0, 300.0), in_pixels(beams(TWO).views), HEIGHTS)
    ratio = 50.0 - 100.0**2 / (300.0 + RETRIEVED**-2)
    np.testing.assert_allclose(told.ratios, [ratio])
    np.testing.assert_allclose(told.errors[:, 1], np.sqrt(0.5 / (1 + ratio)))
    assert not told.errors[:, [0, 2, 3, 4]].any()
    assert told.words(25.0) == []


def test_what_is_not_told_is_named_with_its_parts():
    (said,) = RowInformation.of(information(0.5, 0.0, 1.0), in_pixels(beams(TWO).views), HEIGHTS).words(25.0)
    assert said.startswith("rows say less than is known of this combination")
    assert "shift y of view 0" in said
    assert "shift y of view 1" in said
    assert "turn" not in said
    assert "roll" not in said


def test_a_motion_that_moves_what_is_known_is_none():
    """Turns x of two views are known: of turns of the whole object only that about y is left."""
    expected = np.array([0.0, 0.0, 0.0, 1.0, 1.0])
    told = RowInformation.of(np.zeros((2 * COUNT, 2 * COUNT)), in_pixels(beams(TWO).views), expected)
    assert len(told.ratios) == 2 * 2 - 1
    free = RowInformation.of(np.zeros((2 * COUNT, 2 * COUNT)), in_pixels(beams(TWO).views), expected + [0, 0, 1, 0, 0])
    assert len(free.ratios) == 2 * 3 - 3
    assert told.combinations.shape == (3, 2, NUMBERS)
