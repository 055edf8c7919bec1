"""Rows of beams in one plane: what they find without a volume, what they cannot tell, and beams that are reversed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from helpers.misaligned_balls import SHAPE
from helpers.moving_balls import beams, thickness
from helpers.row_images import gaussians, placed
from holosplat.align.derivatives import RowInformation, in_pixels, motions, moved_onto
from holosplat.align.initial_geometry import NONE, REVERSED, Images, geometry_from_rows
from holosplat.align.row_sums import COUNT, RowPrior, Rows, by_rows, conditions, plane_angles
from holosplat.beamline.misalignment import Misalignment
from holosplat.geometry import Views, rotation_tilted

EXPECTED = np.array([2.0, 2.0, *np.deg2rad([1.0, 1.0, 1.0])])
THREE, TWO = (0.0, 30.0, 48.0), (0.0, 23.8)
WHEN = np.linspace(-1, 1, 4)


def images(angles: tuple[float, ...], errors: Misalignment, balls: int = 8) -> tuple[np.ndarray, Views, Views]:
    """Thickness [4, V, H, W] of moving balls, planned and true views in pixels."""
    planned = beams(angles)
    true = errors.true_exposures(planned).views
    values = np.stack([thickness(true, when, balls).double().numpy() for when in WHEN])
    return values, in_pixels(planned.views), in_pixels(true)


def apart(found: Views, true: Views) -> tuple[float, float, float]:
    """Rms of shifts, turns about x, and rolls [degrees], but for a motion of the whole object."""
    moved = moved_onto(found, true)
    turns = Rotation.from_matrix(np.einsum("vij,vkj->vik", moved.rotations, true.rotations)).as_rotvec(degrees=True)
    parts = moved.shifts - true.shifts, turns[:, 0], turns[:, 2]
    shift, tilt, roll = (float(np.sqrt(np.mean(part**2))) for part in parts)
    return shift, tilt, roll


@pytest.mark.parametrize("angles", [THREE, TWO])
def test_beams_are_found_without_a_volume(angles):
    """Shifts, turns about x and rolls; the angle between beams is as planned."""
    values, planned, true = images(angles, Misalignment(1.0, 0.6, 0.0, seed=2))
    held = EXPECTED * [1, 1, 1, 0, 1]
    found = by_rows(values, planned, RowPrior.of(held, len(angles)), WHEN)
    before, after = apart(planned, true), apart(placed(found.numbers, planned), true)
    assert before[0] > 0.3
    assert after[0] < 0.05
    assert after[1] < 0.15
    assert after[2] < 0.1
    assert np.all(found.after < 0.1 * found.before)
    assert not found.numbers[:, 3].any()


@pytest.mark.parametrize("number", range(COUNT - 1))
def test_derivatives_are_those_of_gaussians(number):
    views = in_pixels(beams(THREE).views)
    step = 1e-4 if number < 2 else 1e-5

    def left(size: float) -> np.ndarray:
        numbers = np.zeros((3, 5))
        numbers[1, number] = size
        return conditions(Rows.of(gaussians(placed(numbers, views))), np.deg2rad(THREE), (1.0, 1.0))[0]

    wanted = (left(step) - left(-step)) / (2 * step)
    found = conditions(Rows.of(gaussians(views)), np.deg2rad(THREE), (1.0, 1.0))[1][:, 1, number]
    assert np.abs(left(0.0)).max() < 1e-4 * np.abs(wanted).max()
    np.testing.assert_allclose(found, wanted, atol=0.06 * np.abs(wanted).max())


def test_an_object_that_is_stretched_gives_two_beams_the_same_frames():
    """So that no frames tell the angle between two beams; a third beam would see another object."""
    rotations, turned = (Views.from_angles([0.0, b, 48.0], SHAPE, 1.0).rotations for b in (23.8, 29.0))
    stretch = np.linalg.solve(
        np.concatenate([turned[:2, 0], [[0, 1.0, 0]]]), np.concatenate([rotations[:2, 0], [[0, 1, 0]]])
    )
    r = np.random.default_rng(0)
    place, shape = r.normal(size=3), np.diag([1.0, 2.0, 3.0])
    for k, same in ((0, True), (1, True), (2, False)):
        axes, others = rotations[k, :2], turned[k, :2]
        assert np.allclose(others @ stretch @ place, axes @ place) == same
        assert np.allclose(others @ stretch @ shape @ stretch.T @ others.T, axes @ shape @ axes.T) == same


def told_of(angles: tuple[float, ...], times: slice, balls: int = 8) -> RowInformation:
    values, planned, _ = images(angles, Misalignment(), balls)
    values = values + 0.02 * np.random.default_rng(0).normal(size=values.shape)
    found = by_rows(values[times], planned, RowPrior.of(EXPECTED * [1, 1, 1, 0, 1], len(angles)), WHEN[times])
    return RowInformation.of(found.information, planned, EXPECTED)


def test_two_beams_never_tell_the_angle_between_them():
    """However much moves; all else they tell: the height between them, and two rolls."""
    told = told_of(TWO, slice(None))
    assert len(told.ratios) == 4
    assert told.ratios[0] < 1e-6
    assert told.ratios[1] > 10
    np.testing.assert_allclose(np.abs(told.combinations[0, :, 3]), np.sqrt(0.5), atol=1e-3)
    assert [word for word in told.words(25.0) if "stretched" in word]
    assert told.errors[0, 1] < 0.02 * EXPECTED[1]


def test_matter_that_moves_lets_three_beams_tell_their_angles():
    """The centre of one ball is a point at one time, and a path over all times."""
    once, always = told_of(THREE, slice(0, 1), 1), told_of(THREE, slice(None), 8)
    assert len(once.ratios) == len(always.ratios) == 9
    assert once.ratios[0] < 0.05
    assert always.ratios[0] > 20 * once.ratios[0]
    assert any("angles between beams" in word for word in once.words(25.0))


def test_a_motion_of_the_whole_object_is_not_told():
    values, planned, _ = images(THREE, Misalignment(1.0, 0.6, 0.0, seed=2))
    found = by_rows(values, planned, RowPrior.of(EXPECTED, 3), WHEN)
    moves = np.zeros((3, COUNT, 6))
    moves[:, :5] = motions(placed(np.array([[0, 0, 0, n, 0] for n in found.numbers[:, 3]]), planned)).reshape(3, 5, 6)
    moves = moves.reshape(-1, 6) * np.repeat([[1.0] * 3 + [0.02] * 3], 3 * COUNT, axis=0)
    sizes = np.einsum("ik,ij,jk->k", moves, found.information, moves)
    assert sizes.max() < 1e-3 * np.diag(found.information).max()


def test_a_drift_is_found_beside_the_numbers():
    planned = beams(THREE)
    wanted = np.array([0.4, -0.4, 0.0])
    stack = []
    for when in WHEN:
        shifts = np.stack([np.zeros(3), when * wanted], axis=1) * planned.views.pixel_size
        stack.append(thickness(replace(planned.views, shifts=shifts), when).double().numpy())
    prior = RowPrior(np.tile(EXPECTED * [1, 1, 1, 0, 1], (3, 1)), np.array([1.0, 1, 0, 0, 0]), np.zeros((2, 3, COUNT)))
    found = by_rows(np.stack(stack), in_pixels(planned.views), prior, WHEN)
    np.testing.assert_allclose(found.rates[:, 1] - found.rates[:, 1].mean(), wanted, atol=0.03)
    np.testing.assert_allclose(found.numbers[:, 1] - found.numbers[:, 1].mean(), 0, atol=0.05)


@pytest.mark.parametrize(("side", "axis"), [("y", -2), ("x", -1)])
def test_a_reversed_beam_is_noticed(side, axis):
    """And its numbers are those of its frames turned back."""
    values, planned, true = images(THREE, Misalignment(1.0, 0.6, 0.0, seed=2))
    values[:, 1] = np.flip(values[:, 1], axis)
    found = geometry_from_rows(
        Images(values[1:3], planned, np.zeros(3, dtype=bool), WHEN[1:3]), EXPECTED, np.zeros(5), few=True
    )
    assert found is not None
    assert found.sides == ("", side, "")
    assert found.decision.choice == f"beam 1 along {side}"
    assert apart(placed(found.numbers, planned), true)[0] < 0.05


@pytest.mark.parametrize("angles", [THREE, TWO])
def test_upright_beams_are_left_alone(angles):
    """Of many balls in noise, and of soft matter that is nearly the same upside down."""
    none = np.zeros(len(angles), dtype=bool)
    values, planned, true = images(angles, Misalignment(1.0, 0.6, 0.0, seed=3))
    noise = 0.3 * np.random.default_rng(3).normal(size=values[1:3].shape)
    soft = np.repeat(gaussians(true)[None], 2, axis=0)
    for one in (values[1:3] + noise, soft):
        found = geometry_from_rows(Images(one, planned, none, WHEN[1:3]), EXPECTED, np.zeros(5), few=True)
        assert found is not None
        assert found.sides == ("",) * len(angles)
        assert (found.decision.name, found.decision.choice, found.decision.by) == (REVERSED, NONE, "the same rows")


@pytest.mark.parametrize(("share", "free"), [(0.6, False), (1.6, True)])
def test_angles_between_beams_are_free_where_they_are_told_firmly(share, free):
    """What is told of them grows with the square of what is uncertain; 25 times that is a fifth of the error."""
    values, planned, _ = images(THREE, Misalignment(1.0, 0.6, 0.0, seed=2))
    held = by_rows(values, planned, RowPrior.of(EXPECTED * [1, 1, 1, 0, 1], 3), WHEN)
    least = RowInformation.of(held.information, planned, EXPECTED).ratios[0]
    expected = EXPECTED * np.sqrt(share * 25.0 / least)
    found = geometry_from_rows(Images(values, planned, np.zeros(3, dtype=bool), WHEN), expected, np.zeros(5), few=True)
    assert found is not None
    assert found.numbers[:, 3].any() == free


def test_beams_beside_a_plane_have_no_rows_in_common():
    assert plane_angles(Views.from_rotations(rotation_tilted([0, 30], [0, 4]), SHAPE, 1.0)) is None
    angles = plane_angles(Views.from_angles([0, 30], SHAPE, 1.0))
    assert angles is not None
    np.testing.assert_allclose(angles, np.deg2rad([0, 30]))
    values, planned, _ = images(TWO, Misalignment())
    tilted = replace(planned, rotations=rotation_tilted([0, 30], [0, 4]))
    assert (
        geometry_from_rows(Images(values, tilted, np.zeros(2, dtype=bool), WHEN), EXPECTED, np.zeros(5), few=True)
        is None
    )


def test_matter_that_passes_the_edges_is_noticed():
    values, planned, _ = images(TWO, Misalignment())
    cut = values[:, :, :, 9:-9]
    none = np.zeros(2, dtype=bool)
    narrow = replace(planned, shape=cut.shape[2:])
    assert not Images(values, planned, none, WHEN).passing()
    assert Images(cut, narrow, none, WHEN).passing()
