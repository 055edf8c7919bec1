"""The search for one geometry of all times: numbers and rates in their places, what is held, and what is forgotten."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from helpers.misaligned_balls import MATERIAL
from helpers.moving_balls import beams, series
from holosplat.align import Drift, PoseOptions, PosePrior
from holosplat.align.derivatives import NUMBERS, Normal
from holosplat.align.poses import DISTANCE, MAGNIFICATION, Level, PoseSearch
from holosplat.align.series_search import Moment, SeriesSearch
from holosplat.beamline.misalignment import Misalignment

WHENS, ORDERS = (-1.0, 0.5), ([2, 0, 1], [0, 1, 2])
WIDE = PoseOptions(PosePrior(100, 20, 20, 0.5, 0.5, 0.1), drift=Drift(100, 20))


@pytest.fixture(scope="module")
def moments() -> list[Moment]:
    """Two times of three beams, whose frames come in another order at the first."""
    scan, _ = series(beams((0.0, 30.0, 48.0)), Misalignment(), 1)
    return [Moment(scan.as_static()[order], np.array(order), 0.0, when) for when, order in zip(WHENS, ORDERS)]


@pytest.fixture
def search(moments) -> SeriesSearch:
    """At random numbers and rates."""
    made = SeriesSearch(moments, 3, MATERIAL, WIDE, 1.0)
    made.numbers, made.rates = some()
    return made


def some() -> tuple[torch.Tensor, torch.Tensor]:
    r = torch.Generator().manual_seed(0)
    numbers, rates = (1e-3 * torch.randn(3, len(NUMBERS), generator=r, dtype=torch.float64) for _ in range(2))
    return numbers, rates


def said(number: float) -> list[Normal]:
    """Normal equations of the two times, by which every number and every rate is to grow by `number`."""
    information = 1e12 * torch.eye(len(NUMBERS), dtype=torch.float64).repeat(3, 1, 1)
    growth = torch.full((3, len(NUMBERS)), 1e12 * number, dtype=torch.float64)
    return [Normal(information, (1 + when) * growth) for when in WHENS]


def test_frames_of_each_time_are_where_numbers_and_rates_place_them(search, monkeypatch):
    """Each frame by its own beam."""
    looked: list[torch.Tensor] = []

    def look(self: PoseSearch, at: object) -> Normal:
        looked.append(self.numbers.clone())
        return said(0.0)[0]

    monkeypatch.setattr(PoseSearch, "looked", look)
    level = search.levels()[0]
    search.run(Level(**{**vars(level), "rounds": 1}), lambda done: None)
    numbers, rates = some()
    for found, when, order in zip(looked, WHENS, ORDERS):
        torch.testing.assert_close(found, numbers[order] + when * rates[order])


def test_what_is_held_stays(search):
    """Numbers and rates alike; the others move."""
    search.hold(2, 3)
    search.solve(said(1e-2), turning=True)
    numbers, rates = some()
    for found, begun in ((search.numbers, numbers), (search.rates, rates)):
        assert torch.equal(found[:, 2:4], begun[:, 2:4])
        assert bool((found[:, [0, 1, 4]] != begun[:, [0, 1, 4]]).all())


def test_what_is_not_uncertain_does_not_drift(moments):
    known = PoseOptions(PosePrior(shift=0.0), drift=Drift(100, 20))
    search = SeriesSearch(moments, 3, MATERIAL, known, 1.0)
    search.solve(said(1e-2), turning=True)
    assert not search.rates[:, :2].any()
    torch.testing.assert_close(search.rates[:, 2:5], torch.full((3, 3), 1e-2, dtype=torch.float64))


def test_a_magnification_of_all_beams_is_none(search):
    """The object may as well be larger."""
    search.solve(said(1e-2), turning=True)
    assert abs(float(search.numbers[:, MAGNIFICATION].mean())) < 1e-12
    assert bool((search.numbers[:, MAGNIFICATION] != 0).all())


def test_distances_are_forgotten_with_their_rates(search):
    search.forget_distance()
    numbers, rates = some()
    for found, begun in ((search.numbers, numbers), (search.rates, rates)):
        assert not found[:, DISTANCE].any()
        others = [k for k in range(len(NUMBERS)) if k != DISTANCE]
        assert torch.equal(found[:, others], begun[:, others])
