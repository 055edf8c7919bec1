"""Series: one geometry of the beams for all times, by rows or by volumes; drifts; which times and frames are used."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from helpers.misaligned_balls import MATERIAL, PIXEL
from helpers.moving_balls import beams, series
from holosplat.align import AlignedBeams, Drift, PoseOptions, PosePrior, align_views
from holosplat.align.derivatives import NUMBERS, Normal, moved_onto
from holosplat.align.find import DRIFT, LINEAR, STAY
from holosplat.align.series_search import Beams, Moment, SeriesSearch, chosen_moments
from holosplat.beamline.misalignment import Misalignment
from holosplat.checks import InputError
from holosplat.matter import MaterialPrior
from holosplat.scan import Exposures, Scan

PRIOR = MaterialPrior.known(MATERIAL)
ERRORS = Misalignment(1.0, 0.6, 0.0, seed=2)


def apart(found: Exposures, true: Exposures) -> tuple[float, float]:
    """Rms of shifts [pixels] and rolls [degrees], but for a motion of the whole object."""
    moved = moved_onto(found.views, true.views)
    turns = np.einsum("vij,vkj->vik", moved.rotations, true.views.rotations)
    roll = Rotation.from_matrix(turns).as_rotvec(degrees=True)[:, 2]
    return float(np.sqrt((((moved.shifts - true.views.shifts) / PIXEL) ** 2).mean())), float(np.sqrt((roll**2).mean()))


@pytest.fixture(scope="module")
def three() -> tuple[Scan, Exposures]:
    return series(beams((0.0, 30.0, 48.0)), ERRORS, 4)


def test_one_geometry_of_three_beams_is_found_for_all_times(three):
    scan, true = three
    found = align_views(scan, PRIOR, PoseOptions(retrieval=15, rounds=1, first=20))
    assert isinstance(found, AlignedBeams)
    before, after = apart(scan.exposures[:3], true[:3]), apart(found.exposures[:3], true[:3])
    assert before[0] > 0.5
    assert after[0] < 0.08
    assert after[1] < 0.15 < before[1]
    for k in (1, 2, 3):
        np.testing.assert_array_equal(found.exposures.views.shifts[3 * k : 3 * k + 3], found.exposures.views.shifts[:3])
    np.testing.assert_array_equal(found.exposures.time, scan.exposures.time)
    text = "\n".join(found.lines())
    assert "3 beams, from 4 times" in text
    assert "angles between beams: they are as planned" in text
    assert not found.drift.any()


def test_held_out_beams_are_placed_and_have_no_part_in_the_others(three):
    scan, true = series(beams((0.0, 30.0, 48.0, 15.0)), ERRORS, 2)
    is_test = np.tile([False, False, False, True], 2)
    found = align_views(scan.with_split(is_test), PRIOR, PoseOptions(retrieval=15, rounds=1, first=20))
    alone = align_views(scan[np.flatnonzero(~is_test)], PRIOR, PoseOptions(retrieval=15, rounds=1, first=20))
    assert apart(scan.exposures[:4], true[:4])[0] > 0.5
    assert apart(found.exposures[:4], true[:4])[0] < 0.12
    both = moved_onto(found.exposures.views[:3], alone.exposures.views[:3])
    np.testing.assert_allclose(both.shifts, alone.exposures.views.shifts[:3], atol=1e-3 * PIXEL)


def test_a_drift_is_told_where_it_is_beyond_doubt(three):
    planned = beams((0.0, 30.0, 48.0))
    options = PoseOptions(retrieval=15, rounds=1, first=20, drift=Drift(shift=2.0))
    scan, true = series(planned, ERRORS, 4, drift=2.0)
    found = align_views(scan, PRIOR, options)
    assert [one.choice for one in found.decisions if one.name == DRIFT] == [LINEAR]
    assert any("drifts, first time to last" in line for line in found.lines())
    for k in (0, 9):
        assert apart(found.exposures[k : k + 3], true[k : k + 3])[0] < 0.1
    still = align_views(three[0], PRIOR, options)
    assert [one.choice for one in still.decisions if one.name == DRIFT] == [STAY]
    assert isinstance(still, AlignedBeams)
    assert not still.drift.any()


def test_a_beam_that_is_upside_down_is_turned_back(three):
    scan, true = three
    frames = scan.frames.copy()
    frames[1::3] = frames[1::3, ::-1]
    found = align_views(
        Scan(frames, scan.exposures, scan.is_test), PRIOR, PoseOptions(retrieval=15, rounds=1, first=20)
    )
    assert isinstance(found, AlignedBeams)
    assert "beam 1 is reversed along y: its frames were turned back" in found.words
    np.testing.assert_array_equal(found.upright(frames), scan.frames)
    assert apart(found.exposures[:3], true[:3])[0] < 0.08


def test_volumes_of_all_times_move_the_beams_together():
    """Four beams that are not in one plane: rows tell nothing."""
    planned = beams((0.0, 40.0, 85.0, 130.0))
    tilts = Rotation.from_rotvec(np.deg2rad([[0, 0, 0], [5, 0, 0], [-4, 0, 0], [3, 0, 0]])).as_matrix()
    planned = replace(planned, views=replace(planned.views, rotations=tilts @ planned.views.rotations))
    scan, true = series(planned, Misalignment(1.0, 0.0, 0.0, seed=2), 2)
    options = PoseOptions(PosePrior(angle=0.0, roll=0.0), rounds=2, retrieval=10, first=10)
    found = align_views(scan, PRIOR, options)
    assert apart(scan.exposures[:4], true[:4])[0] > 0.5
    assert apart(found.exposures[:4], true[:4])[0] < 0.2
    np.testing.assert_array_equal(found.exposures.views.shifts[:4], found.exposures.views.shifts[4:])


def test_the_times_normal_equations_are_those_of_numbers_and_rates(three):
    """A step solves `slope = (numbers + τ rates)` of two times exactly, where the prior is wide."""
    scan, _ = three
    moments = [Moment(scan[[0, 1, 2]].as_static(), np.arange(3), 0.0, when) for when in (-1.0, 0.5)]
    wide = PoseOptions(PosePrior(100, 20, 20, 0.5, 0.5), drift=Drift(100, 20))
    search = SeriesSearch(moments, 3, MATERIAL, wide, 1.0)
    r = torch.Generator().manual_seed(0)
    numbers, rates = (1e-2 * torch.randn(3, len(NUMBERS), generator=r, dtype=torch.float64) for _ in range(2))
    rates[:, 5:] = 0
    numbers[:, 6] = 0
    information = 1e12 * torch.eye(len(NUMBERS), dtype=torch.float64).repeat(3, 1, 1)
    said = [1e12 * (numbers + moment.when * rates) for moment in moments]
    search.solve([Normal(information, slope) for slope in said], turning=True)
    torch.testing.assert_close(search.numbers, numbers, atol=1e-6, rtol=0)
    torch.testing.assert_close(search.rates, rates, atol=1e-6, rtol=0)


def test_of_each_part_of_a_series_the_time_that_says_most_is_used(three):
    scan, _ = series(beams((0.0, 30.0)), Misalignment(), 4)
    frames = np.concatenate([scan.frames] * 2)
    frames[[0, 1, 4, 5, 6, 7, 14, 15]] = 1.0
    planned = beams((0.0, 30.0)).repeated(np.arange(8.0))
    whole = Scan(frames, planned, np.zeros(16, dtype=bool))
    chosen = chosen_moments(whole, Beams.of(whole), 3, 2)
    assert chosen[0].time == 1.0
    assert all(moment.time not in (0.0, 2.0, 3.0, 7.0) for moment in chosen)
    assert chosen[0].when == pytest.approx(-5 / 7)
    assert len(chosen_moments(whole, Beams.of(whole), 20, 2)) == 8


def test_series_without_beams_that_stay_are_refused(three):
    scan, _ = three
    views = scan.views
    turned = replace(views, shifts=views.shifts + PIXEL * np.arange(len(scan))[:, None])
    with pytest.raises(InputError, match="no planned pose comes twice"):
        align_views(scan.with_views(turned), PRIOR)
    alike = replace(views, rotations=np.repeat(views.rotations[:1], len(scan), axis=0))
    with pytest.raises(InputError, match="two frames of one planned pose"):
        align_views(scan.with_views(alike), PRIOR)
    with pytest.raises(InputError, match="2 training frames"):
        align_views(scan.with_split(np.arange(len(scan)) % 3 > 0), PRIOR)
    with pytest.raises(InputError, match="angle"):
        Drift(angle=-1.0)
