"""What noise does to the comparison of two objects by their frames, and what is left without it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

import holosplat as hs
from holosplat.methods.cross_validation import MissingMatter
from holosplat.methods.evidence import Evidence, Floor
from holosplat.optics.noise_model import NoiseModel

MATERIAL = hs.DeltaBeta(2e-7, 2e-10)
SHAPE = (27, 38)
SIGMA = torch.tensor([0.03, 0.05], dtype=torch.float64)


def bump(row: float, column: float, size: float) -> Tensor:
    """A pattern [1, H, W]."""
    y, x = (torch.arange(n, dtype=torch.float64) for n in SHAPE)
    return torch.exp(-((y[:, None] - row) ** 2 + (x - column) ** 2) / (2 * size**2))[None]


TRUE = 1 + 0.4 * torch.cat([bump(13, 19, 4), bump(12, 16, 5)])
FIRST, SECOND = TRUE + 0.2 * bump(10, 13, 3), TRUE + 0.2 * bump(17, 24, 3)
"""Two predictions that are as wrong as each other, by more than the noise may hide."""


def noise_of(grain: bool) -> NoiseModel:
    """White noise, and such as falls with frequency."""
    white = NoiseModel.white_only(SIGMA, SHAPE)
    fy, fx = torch.fft.fftfreq(SHAPE[0])[:, None], torch.fft.rfftfreq(SHAPE[1])
    return white.with_more(0.01 * torch.exp(-((fy**2 + fx**2) / 0.01)).double()) if grain else white


def judge(frames: Tensor) -> MissingMatter:
    """Of two frames behind some matter."""
    views = hs.Views.from_angles(np.array([0.0, 70.0]), SHAPE, 0.5e-6)
    scan = hs.Scan(frames.float().numpy(), hs.Exposures.of(views, 12.0, 0.02), np.zeros(2, dtype=bool))
    return MissingMatter(scan, MATERIAL)


@pytest.mark.parametrize("grain", [False, True], ids=["white", "grain"])
def test_noise_changes_sureness_by_its_own_standard_deviation(grain):
    noise, of_true = noise_of(grain), judge(TRUE)
    evidence, found = Evidence(of_true, noise), []
    for seed in range(200):
        of_true.measured = TRUE + noise.drawn(1000 + seed)
        found.append(evidence.sureness(FIRST, SECOND))
    assert np.std(found) == pytest.approx(1, abs=0.35)  # of 16 draws, and 200
    of_true.measured = TRUE
    nearer = TRUE + 0.5 * (FIRST - TRUE)
    assert evidence.sureness(nearer, FIRST) > 0
    assert evidence.sureness(FIRST, nearer) == pytest.approx(-evidence.sureness(nearer, FIRST), rel=1e-9)
    assert evidence.sureness(FIRST, FIRST) == 0


def test_sureness_falls_with_the_noise():
    """The part of the noise is linear in it, and the gain is of the frames."""
    one, two = (Evidence(judge(TRUE), NoiseModel.white_only(s * SIGMA, SHAPE)) for s in (1e-4, 2e-4))
    nearer = TRUE + 0.5 * (FIRST - TRUE)
    assert one.sureness(nearer, FIRST) == pytest.approx(2 * two.sureness(nearer, FIRST), rel=1e-3)


def test_frames_without_noise_are_sure_at_once():
    none = NoiseModel.white_only(torch.zeros(2), SHAPE)
    evidence = Evidence(judge(TRUE), none)
    assert evidence.sureness(TRUE, SECOND) > 1e3
    assert evidence.matter == evidence.contrast == Floor(0.0, 0.0)
    shares = evidence._judge.squares(evidence._judge.measured - SECOND)
    assert evidence.left(SECOND) == pytest.approx((shares[0] * shares[1]) ** 0.25, rel=1e-9)
    assert evidence.share(SECOND) == pytest.approx(shares[0] ** 0.5, rel=1e-9)


def test_what_is_left_beyond_noise_is_what_is_left_without():
    """Of an object that is wrong by more than the noise; and of the true one, no more than noise may hide."""
    noise, wrong = noise_of(False), TRUE + 0.1 * torch.cat([bump(10, 14, 4), bump(17, 22, 4)])
    noisy = judge(TRUE + noise.drawn(5))
    evidence, squares = Evidence(noisy, noise), noisy.squares(noisy.measured - wrong)
    clean = noisy.squares(TRUE - wrong)
    assert squares[1] > 1.5 * clean[1]
    assert evidence.contrast.taken_off(squares[1]) == pytest.approx(clean[1], rel=0.15)
    assert evidence.left(wrong) == pytest.approx((clean[0] * clean[1]) ** 0.25, rel=0.2)
    assert evidence.left(TRUE) < 0.4 * evidence.left(wrong)


def test_a_floor_is_never_below_what_noise_may_hide():
    assert Floor(0.5, 0.1).taken_off(0.8) == pytest.approx(0.3)
    assert Floor(0.5, 0.1).taken_off(0.4) == 0.1
    assert replace(Floor(0.0, 0.0), mean=0.2).taken_off(0.2) == 0


def test_what_noise_may_hide_is_not_missing():
    noise, of_true = noise_of(False), judge(TRUE)
    evidence, missing = Evidence(of_true, noise), []
    for seed in range(100):
        of_true.measured = TRUE + noise.drawn(1000 + seed)
        missing.append(evidence.missing(TRUE))
    assert np.mean([share > 0 for share in missing]) < 0.2  # 2 standard deviations, of 16 draws
    assert evidence.missing(FIRST) == evidence.share(FIRST) > 0
