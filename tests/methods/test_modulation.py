"""What a prior has taken is given back by the frequencies that know it."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch.nn.functional import avg_pool3d

from helpers.blobs import MATERIAL, SHAPE, blob_scan, blobs
from holosplat.fit.smooth_volume import ContinuousPrior, VolumeProblem
from holosplat.fit.whitened import WhitenedFrames
from holosplat.geometry import Grid
from holosplat.methods.modulation import Ranges, Told, best, modulated, modulations, unshrunk
from holosplat.optics.noise import NoiseModel
from holosplat.scan import Scan

SIGMA = 0.04
"""Standard deviation of the noise."""


def matter() -> torch.Tensor:
    """The occupancy on 31 × 25 × 31 voxels."""
    return blobs(Grid.of_views(blob_scan().views))


def problem(scan: Scan | None = None, noise: NoiseModel | None = None) -> VolumeProblem:
    """Of six views of 25 × 31 pixels."""
    measured = scan or blob_scan()
    known = noise or NoiseModel.of_frames(torch.from_numpy(measured.frames))
    return VolumeProblem(WhitenedFrames(measured, MATERIAL, known), ContinuousPrior(), 1.0)


def noisy(seed: int) -> VolumeProblem:
    """The same in white noise."""
    quiet = blob_scan()
    frames = quiet.frames + np.random.default_rng(seed).normal(0, SIGMA, quiet.frames.shape).astype(np.float32)
    noise = NoiseModel.white_only(torch.full((len(quiet),), SIGMA, dtype=torch.float64), SHAPE)
    return problem(Scan(frames, quiet.exposures, quiet.is_test), noise)


def blurred(u: torch.Tensor) -> torch.Tensor:
    """Fainter, and with edges that are too soft, as a prior makes it in noise."""
    return 0.8 * avg_pool3d(u[None], 5, stride=1, padding=2)[0]


def share(u: torch.Tensor) -> float:
    return float(u.sum() / matter().sum())


def test_modulations_give_back_what_was_taken():
    """A fifth of all matter, and more of one side, is found again in the frames."""
    p = problem()
    side = torch.linspace(0.7, 0.9, matter().shape[2])
    less = matter() * side
    assert share(less) < 0.82
    assert share(modulated(p, less)) == pytest.approx(1.0, abs=0.05)
    assert share(unshrunk(p, less)) == pytest.approx(1.0, abs=0.05)
    assert len(modulations(less, 1.0)) == 7


def test_low_frequencies_give_back_what_soft_edges_hide():
    """Over seeds of noise: all frequencies answer to the edges, and miss the total."""
    less = blurred(matter())
    by_all = [share(modulated(noisy(seed), less)) for seed in range(4)]
    by_range = [share(unshrunk(noisy(seed), less)) for seed in range(4)]
    assert np.mean(by_range) == pytest.approx(1.0, abs=0.03)
    assert abs(np.mean(by_range) - 1) < 0.5 * abs(np.mean(by_all) - 1)


def test_the_narrowest_range_is_left_out_in_uneven_light(monkeypatch):
    seen = list[list[float]]()
    by_range = Ranges.by_range
    monkeypatch.setattr(Ranges, "by_range", lambda self, u, limits: seen.append(limits) or by_range(self, u, limits))
    p, less = noisy(0), blurred(matter())
    unshrunk(p, less)
    unshrunk(p, less, uneven=True)
    assert len(seen[0]) > 1
    assert seen[1] == seen[0][1:]


def test_a_range_that_does_no_good_gives_way_to_all_frequencies(monkeypatch):
    p, less = problem(), 0.8 * matter()
    monkeypatch.setattr(Ranges, "by_range", lambda self, u, limits: [Told(1.0, 1.0, 0.1 * u, 1.0)])
    assert torch.equal(unshrunk(p, less), modulated(p, less))
    monkeypatch.setattr(Ranges, "by_range", lambda self, u, limits: [Told(0.0, 1.0, 0 * u, 1.0)])
    assert torch.equal(unshrunk(p, less), modulated(p, less))


def test_a_total_does_not_ruin_what_other_frequencies_say(monkeypatch):
    """What its narrow range likes, and what is far from the frames at all others."""
    p, less = noisy(0), 0.8 * matter()
    ranges, row = Ranges(p), torch.arange(matter().shape[1])
    ruined = matter() * (1 + 0.3 * (-1.0) ** row[:, None])
    narrow = ranges.limits[0]
    assert ranges.misfit(ruined, narrow) < ranges.misfit(less, narrow)
    assert ranges.misfit(ruined, 1.0) > 3 * ranges.misfit(less, 1.0)
    monkeypatch.setattr(Ranges, "by_range", lambda self, u, limits: [Told(1.0, 1.0, ruined, narrow)])
    assert torch.equal(unshrunk(p, less), modulated(p, less))


def test_ranges_widen_by_octaves_to_all_frequencies():
    ranges = Ranges(problem())
    assert ranges.limits[-1] == 1.0
    assert all(b == pytest.approx(2 * a) for a, b in zip(ranges.limits[:-2], ranges.limits[1:-1]))
    u = 0.7 * matter()
    misfit = ranges.misfit(u, 1.0)
    assert misfit == pytest.approx(2 * ranges.problem.frames(ranges.problem.lines(u)).value, rel=1e-3)
    assert ranges.misfit(u, ranges.limits[0]) < misfit


def test_the_best_range_is_sure_and_agrees_with_narrower_ones():
    def told(value: float, variance: float, limit: float) -> Told:
        return Told(value, variance, torch.zeros(1), limit)

    agreeing = [told(1.0, 0.04, 0.1), told(1.05, 0.01, 0.2), told(1.02, 0.0025, 1.0)]
    assert best(agreeing).limit == 1.0
    biased = [*agreeing[:2], told(0.5, 0.0001, 1.0)]
    assert best(biased).limit == 0.2
    assert best(biased[::2]).variance == pytest.approx(0.04)
