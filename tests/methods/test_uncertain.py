"""Constants that are known to a range: found where frames show them, and said to be open where they do not."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from helpers.blobs import MATERIAL as BLOBS
from helpers.blobs import SHAPE, blob_scan
from helpers.short import QUICK
from helpers.soft import DISTANCE, MATERIAL, PIXEL, two_cells
from holosplat.baselines.beyond import rows_beyond
from holosplat.checks import InputError
from holosplat.inference import Score
from holosplat.matter import MaterialPrior
from holosplat.methods import Task
from holosplat.methods.method import first_of_task
from holosplat.methods.profile import Profile, exposed, without_specks
from holosplat.methods.uncertain import (
    Determined,
    Search,
    Uncertain,
    at_energy,
    determine,
    likeliest_ratio,
    told,
    without_idle,
)

pytestmark = pytest.mark.usefixtures("unjudged_runs")

RATIO = MaterialPrior.of_ratio(MATERIAL.ratio)


@pytest.fixture(scope="module")
def scan():
    """Two soft cells in five views of 31 × 35 pixels at 20 keV, without noise."""
    return two_cells(5)


def test_a_distance_is_found_within_its_range(scan):
    (found,) = determine(Task(scan, RATIO), Uncertain(distance=(0.8 * DISTANCE, 1.8 * DISTANCE)), QUICK)
    assert found.told
    assert found.low < DISTANCE < found.high
    assert found.value == pytest.approx(DISTANCE, rel=0.15)
    assert "by the frames" in found.line()


def test_frames_that_cut_bodies_are_compared_to_volumes_with_rows_beyond_them():
    """Without these rows a body that goes on has its likeliest distance where halos of the cut are the least."""
    part = blob_scan(count=3).cropped(slice(7, 18), slice(0, SHAPE[1]))
    at = {"distance": float(part.exposures.distance[0]), "delta_beta": BLOBS.ratio}
    profile = Profile(Task(part, RATIO), BLOBS.ratio, at, [at], replace(QUICK, iterations=4))
    rows = len(part.frames[0]) + 2 * rows_beyond(profile.support.float(), part, BLOBS.beta / BLOBS.delta)
    assert rows > len(part.frames[0])
    assert profile.support.shape[1] == profile.frames(at).field.shape[0] == rows
    far = at | {"distance": 1.3 * at["distance"]}
    assert profile(at) < profile(far)


def test_a_ratio_is_found_where_nothing_is_known(scan):
    found = likeliest_ratio(Task(scan, MaterialPrior.unknown()), QUICK)
    assert found.told
    assert found.value == pytest.approx(MATERIAL.ratio, rel=0.15)
    assert found.low < MATERIAL.ratio < found.high


def ratio_of(scan) -> float:
    return first_of_task(Task(scan, MaterialPrior.unknown())).material.ratio


def test_the_search_begins_at_the_estimate_within_the_range(scan, begun_once, monkeypatch):
    """Of δ/β, and of nothing else: a distance begins in the middle of its range."""
    tried = list[dict[str, float]]()

    def first(self, constants):
        tried.append(dict(constants))
        raise KeyboardInterrupt

    monkeypatch.setattr(Profile, "__call__", first)
    estimate = ratio_of(scan)
    for high in (2 * estimate, 0.5 * estimate):
        ranges = Uncertain(distance=(0.04, 0.09), delta_beta=(0.1 * estimate, high))
        with pytest.raises(KeyboardInterrupt):
            determine(Task(scan, MaterialPrior.unknown()), ranges, QUICK)
    assert [one["distance"] for one in tried] == pytest.approx([0.06, 0.06])
    at = ratio_of(replace(scan, exposures=replace(scan.exposures, distance=0.06)))
    assert [one["delta_beta"] for one in tried] == pytest.approx([at, 0.5 * estimate])


class Valley:
    """A misfit that is a square in logarithms: one direction is steep, the other one `flat`."""

    noise_share = 0.0

    def __init__(self, flat: float) -> None:
        self.flat = flat

    def __call__(self, constants) -> float:
        x, y = math.log(constants["distance"] / 0.12), math.log(constants["delta_beta"] / 1200.0)
        return 2000 * (x - y) ** 2 + self.flat * (x + y) ** 2


def searched(flat: float):
    ranges = {"distance": (0.06, 0.2), "delta_beta": (500.0, 3000.0)}
    return Search(Valley(flat), ranges, Task(blob_scan(count=2), MaterialPrior.unknown())).run()


def test_two_constants_that_frames_tell_are_both_found():
    distance, ratio = searched(1000.0)
    assert distance.told
    assert ratio.told
    assert distance.value == pytest.approx(0.12, rel=0.02)
    assert ratio.value == pytest.approx(1200.0, rel=0.02)
    assert distance.low < 0.12 < distance.high < 0.14


@pytest.mark.parametrize(("noise_share", "most", "right"), [(0.0, 21, 0.01), (0.25, 16, 0.1)])
def test_a_search_is_as_fine_as_its_systematic_error_and_no_finer(noise_share, most, right):
    """Of a valley that is steeper on one side: by one step of Newton's, the value is off by 0.036."""
    asked = list[float]()

    def valley(constants):
        asked.append(constants["delta_beta"])
        x = 2 * math.log(constants["delta_beta"] / 700.0)
        return 750 * (math.exp(x) - x - 1)

    valley.noise_share = noise_share
    ranges = {"delta_beta": (60.0, 20_000.0)}
    (found,) = Search(valley, ranges, Task(blob_scan(count=2), MaterialPrior.unknown())).run()
    assert found.value == pytest.approx(700.0, rel=right)
    assert len(asked) <= most


@pytest.mark.parametrize(("begun", "anew"), [(6000.0, True), (900.0, False)])
def test_a_search_that_goes_far_from_where_it_began_begins_anew(begun, anew):
    told = []

    def valley(constants):
        """Where fits begin far off, misfits are others, and the least is not quite there."""
        least, more = (700.0, 1e4) if told else (900.0, 0.0) if anew else (700.0, 0.0)
        return 2000 * math.log(constants["delta_beta"] / least) ** 2 + more

    valley.noise_share = 0.0
    task = Task(blob_scan(count=2), MaterialPrior.unknown())
    (found,) = Search(valley, {"delta_beta": (60.0, 20_000.0)}, task, {"delta_beta": begun}, told.append).run()
    assert found.value == pytest.approx(700, rel=0.02)
    assert len(told) == anew
    assert all(400 < each["delta_beta"] < 1200 for each in told)


def test_fits_of_all_ratios_begin_with_one_volume_and_those_of_each_distance_with_its_own(scan, monkeypatch):
    at = {"distance": DISTANCE, "delta_beta": MATERIAL.ratio}
    profile, began = Profile(Task(scan, RATIO), MATERIAL.ratio, at, [at], replace(QUICK, iterations=1)), []
    volume = profile._volume
    monkeypatch.setattr(profile, "_volume", lambda frames: began.append(frames.material.ratio) or volume(frames))
    for ratio in (1.0, 0.5, 2.0):
        profile(at | {"delta_beta": ratio * MATERIAL.ratio})
    assert began == pytest.approx([MATERIAL.ratio])
    profile(at | {"distance": 1.2 * DISTANCE})
    assert len(began) == 2
    profile.begin(at | {"delta_beta": 3 * MATERIAL.ratio})
    profile(at)
    assert began[2:] == pytest.approx([3 * MATERIAL.ratio])


def test_two_constants_that_frames_tell_only_together_are_said_to_be():
    distance, ratio = searched(0.0)
    assert not distance.told
    assert "only together with others: what explains them grows with δ/β" in distance.line()
    assert distance.low < 0.12 < distance.high
    assert ratio.value / distance.value == pytest.approx(1e4, rel=0.05)  # which is what they do tell


def test_where_a_misfit_levels_off_the_interval_says_so():
    def levels_off(
        constants,
    ) -> float:  # as those of pure phase, which larger ratios all explain
        x = math.log(constants["delta_beta"] / 1200.0)
        return 2000.0 * x**2 if x < 0 else min(2000.0 * x**2, 1.0)

    levels_off.noise_share = 0.0
    ranges = {"delta_beta": (60.0, 20_000.0)}
    found = Search(levels_off, ranges, Task(blob_scan(count=2), MaterialPrior.unknown())).run()[0]
    assert 600 < found.low < 1200
    assert found.high == pytest.approx(20_000.0)
    assert found.told


def test_a_constant_beyond_its_range_is_said_to_be_at_the_end():
    ranges = {"distance": (0.15, 0.3), "delta_beta": (1100.0, 1300.0)}
    distance, _ = Search(Valley(3000.0), ranges, Task(blob_scan(count=2), MaterialPrior.unknown())).run()
    assert "lower end of the range" in distance.line()


def test_absorption_alone_tells_neither():
    scan = blob_scan(0.0)
    task = Task(scan, MaterialPrior.unknown())
    assert not task.delta_told
    for found in determine(task, Uncertain(distance=(1e-9, 1.5e-9), delta_beta=(500.0, 2000.0))):
        assert not found.told
        assert "absorption alone" in found.line()
    given = told(task, determine(task, Uncertain(delta_beta=(500.0, 2000.0))))
    assert given.prior.ratio == pytest.approx(1000.0)
    assert given.delta_told


def test_a_task_takes_what_was_found(scan):
    found = (Determined("energy_kev", 30.0, 25.0, 35.0, (20.0, 40.0), True),)
    task = told(Task(scan, MaterialPrior.known(MATERIAL)), found)
    assert task.scan.exposures.reference_energy == 30.0
    (material,) = task.prior.materials
    assert material.delta == pytest.approx(MATERIAL.delta / 2.25)
    assert material.beta == pytest.approx(MATERIAL.beta / 2.25**2)
    assert told(task, ()) is task


def test_ratios_grow_with_the_square_of_the_energy():
    assert at_energy(RATIO, 2.0).ratio == pytest.approx(4 * RATIO.ratio)
    unknown = MaterialPrior.unknown()
    assert at_energy(unknown, 2.0) is unknown


@pytest.mark.parametrize("ends", [(0.2, 0.1), (0.0, 1.0), (-1.0, 1.0), (1.0, math.inf), (math.nan, 1.0)])
def test_ranges_go_from_a_smaller_to_a_larger_size(ends):
    with pytest.raises(InputError, match="distance must go from a smaller"):
        Uncertain(distance=ends)


def test_what_cannot_be_uncertain_is_refused(scan):
    with pytest.raises(InputError, match="delta_beta must be a range where the material is not known"):
        determine(Task(scan, RATIO), Uncertain(delta_beta=(500.0, 2000.0)))
    exposures = scan.exposures
    several = np.linspace(0.1, 0.2, len(scan))
    other = type(scan)(
        scan.frames, type(exposures)(exposures.views, exposures.energy_kev, several, 0.0, 0.0), scan.is_test
    )
    with pytest.raises(InputError, match="uncertain distance must be that of all frames"):
        determine(Task(other, RATIO), Uncertain(distance=(0.1, 0.3)))


def test_a_bandwidth_that_no_fit_can_sum_is_refused_before_any_fit(scan, monkeypatch):
    """Its upper end takes too many energies."""
    monkeypatch.setattr("holosplat.methods.uncertain.Profile", lambda *given: pytest.fail("a fit was prepared"))
    far = replace(scan, exposures=replace(scan.exposures, distance=np.full(len(scan), 50.0)))
    with pytest.raises(InputError, match=r"a bandwidth of 0\.4 washes out .* more than 32 energies"):
        determine(Task(far, RATIO), Uncertain(bandwidth=(0.001, 0.4)))


def test_what_was_determined_is_read_from_its_table():
    from holosplat.tables import to_table

    found = Determined("distance", 0.1, 0.09, 0.11, (0.05, 0.2), True, "a remark")
    assert Determined.from_dict(to_table(found)) == found


def test_specks_of_noise_are_no_support_but_small_matter_is():
    volume = torch.zeros(12, 13, 15)
    volume[3:7, 3:7, 3:7] = 1.0
    volume[10, 10, 2], volume[9:11, 1, 12] = 0.2, 0.3
    inside = (volume > 0.1).numpy()
    kept = without_specks(volume, inside)
    assert kept.sum() == 64
    assert kept[3:7, 3:7, 3:7].all()
    small = torch.zeros(12, 13, 15)
    small[2::5, 2::5, 2::5] = 1.0
    alone = (small > 0.1).numpy()
    assert np.array_equal(without_specks(small, alone), alone)


class Blurred(Profile):
    """A profile whose frames are predicted better with a bandwidth, by so large a part."""

    def __init__(self, gain: float, frames: int = 8) -> None:
        self._gain, self._frames = gain, frames

    def __len__(self) -> int:
        return self._frames

    def score(self, constants, unseen) -> Score:
        draw = torch.Generator().manual_seed(1)
        left = torch.randn(int(unseen.sum()), 64, 64, generator=draw)
        return Score.of(left * (1 - self._gain * (constants["bandwidth"] > 0)))


@pytest.mark.parametrize(("gain", "frames", "kept"), [(0.1, 8, True), (0.005, 8, False), (0.1, 2, False)])
def test_one_energy_holds_unless_frames_are_predicted_better_with_a_bandwidth(gain, frames, kept):
    found = Determined("bandwidth", 0.03, 0.02, 0.04, (0.01, 0.1), True)
    other = Determined("energy_kev", 20.0, 19.9, 20.1, (19.0, 21.0), True)
    width, energy = without_idle(Blurred(gain, frames), (found, other))  # type: ignore[arg-type]
    assert energy == other
    assert width.value == (0.03 if kept else 0.0)
    assert width.told == kept
    assert kept or "0 is used" in width.line()


def test_frames_set_aside_are_predicted_by_a_volume_of_the_others(scan, monkeypatch):
    """Without a blur, as they are, better than with one of four pixels; nothing begins with a volume of all frames."""
    at = {"distance": DISTANCE, "delta_beta": MATERIAL.ratio}
    profile = Profile(Task(scan, RATIO), MATERIAL.ratio, at, [at], replace(QUICK, iterations=3))
    unseen, began, volume = np.array([False, False, True, False, False]), [], Profile._volume
    profile(at)
    monkeypatch.setattr(Profile, "_volume", lambda self, of: began.append(len(of.train)) or volume(self, of))
    true, wrong = profile.score(at, unseen), profile.score(at | {"psf_sigma_px": 4.0}, unseen)
    assert true.frames == 1
    assert true.gain_over(wrong)[0] > 0
    assert began == [4, 4]


def test_widths_of_light_and_detector_are_those_of_the_exposures(scan):
    """A source blurs by its angle times the distance; a detector's blur is in pixels of the scan."""
    seen = exposed(scan, {"bandwidth": 0.03, "psf_sigma_px": 3.0, "source_angle": 4 * PIXEL / DISTANCE}).exposures
    assert seen.bandwidth == pytest.approx(np.full(5, 0.03))
    assert seen.psf_sigma_px == pytest.approx(np.full(5, 5.0))  # √(3² + 4²)
    at = {"delta_beta": MATERIAL.ratio}
    binned = Profile(Task(scan, RATIO), MATERIAL.ratio, at, [at], replace(QUICK, width=18))
    assert binned.frames({"psf_sigma_px": 3.0}).train.exposures.psf_sigma_px == pytest.approx(np.full(5, 1.5))
