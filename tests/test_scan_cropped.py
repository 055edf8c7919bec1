"""Cropped scans, the axis' column and the sense of rotation: where pixels are in space, by a known object."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.interpolate import CubicSpline

from holosplat.checks import InputError
from holosplat.frames import Frames
from holosplat.geometry import Grid, Views, rotation_tilted, rotation_y
from holosplat.matter import Matter
from holosplat.representations import GaussianCloud
from holosplat.representations.gaussians import raw_of
from holosplat.scan import Exposures, Scan

PIXEL = 3e-6
SHAPE = (23, 31)
ANGLES = [0.0, 40.0, 110.0, 163.0]


def cloud() -> GaussianCloud:
    """Two Gaussians off the axis, of different size and weight."""
    centres = torch.tensor([[3.3, -2.2, 1.4], [-4.1, 3.0, -2.6]])
    scales, turns = torch.log(torch.tensor([[2.0] * 3, [1.6] * 3])), torch.tensor([[1.0, 0, 0, 0]] * 2)
    return GaussianCloud((centres, scales, turns, raw_of(torch.tensor([[0.7], [0.4]]))), PIXEL, Matter.one(1e-6, 1e-9))


def lines(views: Views) -> np.ndarray:
    return cloud().project(views)[1].numpy() / 1e-6


def scan_of(views: Views) -> Scan:
    return Scan(lines(views), Exposures.of(views, 20.0, 0.1, 0.6), np.arange(len(views)) == 2, {"from": "here"})


class Stored(Frames):
    """Frames that are read when they are asked for."""

    def __init__(self, frames: np.ndarray) -> None:
        self._frames, self.shape = frames, frames.shape

    def read(self, numbers: np.ndarray) -> np.ndarray:
        return self._frames[numbers]


@pytest.mark.parametrize("stored", [False, True])
@pytest.mark.parametrize(("rows", "columns"), [((0, 9), (0, 31)), ((4, 21), (3, 24)), ((2, 23), (11, 12))])
def test_the_forward_model_of_a_cropped_scan_is_the_cropped_forward_model(rows, columns, stored):
    views = Views(rotation_y(ANGLES), PIXEL * np.array([[0, 0], [1.3, -0.6], [-0.4, 2.1], [0, 1]]), SHAPE, PIXEL)
    whole = scan_of(views)
    if stored:
        whole = Scan.of(Stored(whole.frames), whole.exposures, whole.is_test, whole.provenance)
    part = whole.cropped(slice(*rows), slice(*columns))
    assert part.views.shape == (rows[1] - rows[0], columns[1] - columns[0])
    np.testing.assert_array_equal(part.frames, whole.frames[:, slice(*rows), slice(*columns)])
    np.testing.assert_allclose(part.frames, lines(part.views), rtol=0, atol=2e-5 * float(whole.frames.max()))
    assert (part.is_test.tolist(), part.provenance) == ([False, False, True, False], {"from": "here"})


@pytest.mark.parametrize("factor", [2, 3])
def test_cropped_and_then_binned_pixels_are_where_they_say(factor):
    whole = scan_of(Views.from_angles(ANGLES, SHAPE, PIXEL))
    part = whole.cropped(slice(1, 20), slice(4, 29)).binned(factor)
    wanted = lines(part.views)
    np.testing.assert_allclose(part.frames, wanted, rtol=0, atol=0.06 * wanted.max())
    moved = lines(Views(part.views.rotations, part.views.shifts + 0.5 * PIXEL, part.views.shape, factor * PIXEL))
    assert np.abs(part.frames - wanted).mean() < 0.3 * np.abs(part.frames - moved).mean()


def test_a_grid_of_a_cropped_scan_lies_where_its_rows_are():
    whole = Views.from_angles(ANGLES, SHAPE, PIXEL)
    grid = Grid.of_views(whole.cropped(slice(0, 9), slice(0, 31)))
    assert grid.shape == (31, 9, 31)
    np.testing.assert_allclose(grid.centre, [0, -7 * PIXEL, 0], atol=1e-12)
    np.testing.assert_allclose(Grid.centred((31, 9, 31), PIXEL, (0.0, -7 * PIXEL, 0.0)).origin, grid.origin, atol=1e-12)


@pytest.mark.parametrize(
    ("rows", "columns", "said"),
    [
        (slice(0, 24), slice(0, 31), "rows to keep must be some of 0:23, but they are 0:24"),
        (slice(0, 9), slice(7, 7), "columns to keep must be some of 0:31, but they are 7:7"),
        (slice(-3, 9), slice(0, 31), "rows to keep"),
    ],
)
def test_a_crop_beyond_the_frames_is_refused(rows, columns, said):
    with pytest.raises(InputError, match=said):
        scan_of(Views.from_angles(ANGLES, SHAPE, PIXEL)).cropped(rows, columns)


@pytest.mark.parametrize("column", [15.0, 12.625, 17.3])
def test_a_point_on_the_axis_stays_at_the_axis_column(column):
    """And the frame at 180° is the frame at 0° mirrored about it."""
    views = Views.from_angles([0.0, 180.0, 65.0], SHAPE, PIXEL).about_column(column)
    j = np.arange(SHAPE[1])
    x = (j + 0.5 - SHAPE[1] / 2) * PIXEL + views.shifts[:, :1]
    np.testing.assert_allclose([np.interp(0.0, row, j) for row in x], column)
    first, last = lines(views)[:2]
    mirrored = CubicSpline(j, last, axis=1)(2 * column - j)
    inside = (2 * column - j > 1) & (2 * column - j < SHAPE[1] - 2)
    np.testing.assert_allclose(mirrored[:, inside], first[:, inside], atol=2e-3 * first.max())


def test_the_axis_column_counts_from_the_middle_of_the_first_column():
    """In the middle of the detector nothing changes: 15 of 31 columns, 15.5 of 32."""
    for width, middle in ((31, 15.0), (32, 15.5)):
        views = Views.from_angles(ANGLES, (5, width), PIXEL)
        np.testing.assert_allclose(views.about_column(middle).shifts, 0, atol=1e-15)


def test_turned_back_views_are_those_of_the_negative_angles():
    views = Views.from_angles(ANGLES, SHAPE, PIXEL)
    np.testing.assert_allclose(views.turned_back().rotations, rotation_y([-a for a in ANGLES]), atol=1e-15)


def test_an_axis_that_cannot_be_is_refused():
    views = Views.from_angles(ANGLES, SHAPE, PIXEL)
    with pytest.raises(InputError, match="one of 0 to 30, but it is 31"):
        views.about_column(31)
    moving = Views(views.rotations, PIXEL * np.array([[0, 0], [1, 0], [0, 0], [0, 0]]), SHAPE, PIXEL)
    with pytest.raises(InputError, match="moves sideways"):
        moving.about_column(12)
    with pytest.raises(InputError, match="none in common"):
        Views.from_rotations(rotation_tilted(ANGLES, [0, 5, 0, 3]), SHAPE, PIXEL).turned_back()
