"""Tomographies of thickness: the contract of the table."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from helpers.discs import ANGLES, PITCH, SHAPE, anyhow, ball_lines, ball_truth, quiet, turned
from holosplat.baselines import TOMOGRAPHIES
from holosplat.checks import InputError
from holosplat.geometry import Grid, Views
from holosplat.metrics import dice


def solved(name: str, views: Views, upper: float | None = 1.0, lines: Tensor | None = None) -> tuple[Tensor, Grid]:
    grid = Grid.of_views(views)
    return TOMOGRAPHIES[name](ball_lines(views) if lines is None else lines, views, grid, upper, quiet), grid


every = pytest.mark.parametrize("name", TOMOGRAPHIES)
iterative = pytest.mark.parametrize("name", [name for name in TOMOGRAPHIES if name != "fbp"])
LEAST_DICE = {"fbp": 0.85, "art": 0.93, "sirt": 0.85, "sirt-nonneg": 0.93, "tv": 0.94}


@every
def test_a_ball_is_found_from_uneven_angles(name):
    volume, grid = solved(name, turned())
    assert volume.shape == grid.shape
    assert volume.dtype == torch.float32
    assert dice(volume.numpy() > 0.5, ball_truth(grid)) > LEAST_DICE[name]


@every
def test_the_mass_is_right(name):
    volume, _ = solved(name, turned(), upper=None)
    mass = float(volume.sum()) / float(ball_lines(turned()).sum() / PITCH / len(ANGLES))
    assert mass == pytest.approx(1, abs=0.2 if name == "fbp" else 0.02)  # fbp: also outside the field of view


@every
def test_detectors_may_be_shifted(name):
    shifts = [(2 * np.sin(i), 0.0) for i in range(len(ANGLES))]
    volume, grid = solved(name, turned(shifts=shifts))
    assert dice(volume.numpy() > 0.5, ball_truth(grid)) > LEAST_DICE[name]


@iterative
def test_views_may_have_any_orientation(name):
    volume, grid = solved(name, anyhow())
    assert dice(volume.numpy() > 0.5, ball_truth(grid)) > LEAST_DICE[name] - 0.05


def test_filtered_backprojection_needs_a_common_axis():
    with pytest.raises(InputError, match="filtered back-projection needs views that turn about the y axis"):
        solved("fbp", anyhow())


@every
def test_nothing_gives_nothing(name):
    volume, _ = solved(name, turned(), lines=torch.zeros(len(ANGLES), *SHAPE))
    assert float(volume.abs().max()) == 0


@every
def test_the_unit_of_length_does_not_matter(name):
    """The same scan in other metres: the same occupancy; twice as thick: no new shape (without bounds)."""
    views, other = turned(), turned(pitch=40 * PITCH)
    one, two = solved(name, views)[0], solved(name, other)[0]
    assert torch.allclose(one, two, atol=2e-4)


@every
@pytest.mark.parametrize("factor", [2, 0.03])
def test_occupancy_is_proportional_to_thickness(name, factor):
    """So that an assumed δ that is far too small makes no other volume."""
    views = turned()
    one, other = solved(name, views, None)[0], solved(name, views, None, factor * ball_lines(views))[0]
    assert torch.allclose(one, other / factor, atol=1e-3)


@every
@pytest.mark.parametrize("upper", [0.7, 1.0])
def test_the_upper_bound_is_kept(name, upper):
    views = turned()
    volume, _ = solved(name, views, upper, 1.5 * ball_lines(views))
    assert float(volume.max()) == pytest.approx(upper)
    assert float(solved(name, views, None, 1.5 * ball_lines(views))[0].max()) > 1.1


@every
def test_progress_is_told(name):
    told: list[float] = []
    views = turned()
    TOMOGRAPHIES[name](ball_lines(views), views, Grid.of_views(views), 1.0, told.append)
    assert told == sorted(told)
    assert told[0] == 0
    assert 0.7 < told[-1] < 1


@every
def test_bad_input_is_refused(name):
    views = turned()
    with pytest.raises(InputError, match=r"must have the shape \(10, 7, 25\)"):
        solved(name, views, lines=torch.zeros(9, *SHAPE))
    broken = ball_lines(views)
    broken[0, 0, 3] = torch.nan
    with pytest.raises(InputError, match="must be finite, but 1 are not"):
        solved(name, views, lines=broken)
    with pytest.raises(InputError, match="upper bound of the occupancy must be a positive number"):
        solved(name, views, 0.0)


@every
def test_voxels_may_be_finer_than_pixels(name):
    views = turned()
    grid = Grid.of_views(views, 2)
    volume = TOMOGRAPHIES[name](ball_lines(views), views, grid, 1.0, quiet)
    assert volume.shape == (50, 14, 50)
    assert dice(volume.numpy() > 0.5, ball_truth(grid)) > LEAST_DICE[name] - 0.05


@pytest.mark.parametrize("name", ["art", "sirt-nonneg", "tv"])
def test_these_keep_the_occupancy_from_below(name):
    assert float(solved(name, turned(), None)[0].min()) == 0
