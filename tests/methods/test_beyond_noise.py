"""What is missing from noisy frames beyond their noise, and what that may hide."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

import holosplat as hs
from holosplat.methods.cross_validation import MissingMatter
from holosplat.optics.noise import NoiseModel

MATERIAL = hs.DeltaBeta(2e-7, 2e-10)
SHAPE = (27, 38)
NOISE = NoiseModel.white_only(torch.tensor([0.03, 0.05], dtype=torch.float64), SHAPE)


def bump(row: float, column: float, size: float) -> Tensor:
    """A pattern [1, H, W]."""
    y, x = (torch.arange(n, dtype=torch.float64) for n in SHAPE)
    return torch.exp(-((y[:, None] - row) ** 2 + (x - column) ** 2) / (2 * size**2))[None]


TRUE = 1 + 0.4 * torch.cat([bump(13, 19, 4), bump(12, 16, 5)])
WRONG = TRUE + 0.2 * bump(10, 13, 3)


def judge(frames: Tensor) -> MissingMatter:
    """Of two frames behind some matter."""
    views = hs.Views.from_angles(np.array([0.0, 70.0]), SHAPE, 0.5e-6)
    scan = hs.Scan(frames.float().numpy(), hs.Exposures.of(views, 12.0, 0.02), np.zeros(2, dtype=bool))
    return MissingMatter(scan, MATERIAL)


def test_what_noise_may_hide_is_not_missing():
    of_true, missing = judge(TRUE), []
    for seed in range(100):
        of_true.scan = replace(of_true.scan, frames=(TRUE + NOISE.drawn(1000 + seed)).float().numpy())
        missing.append(of_true.beyond_noise(TRUE, NOISE))
    assert np.mean([share > 0 for share in missing]) < 0.2  # 2 standard deviations, of 16 draws
    assert of_true.beyond_noise(WRONG, NOISE) > 0


def test_what_is_left_beyond_noise_is_what_is_left_without():
    """Of an object that is wrong by more than the noise."""
    wrong = TRUE + 0.1 * torch.cat([bump(10, 14, 4), bump(17, 22, 4)])
    noisy = judge(TRUE + NOISE.drawn(5))
    clean = (noisy.of(TRUE - wrong) / noisy.whole) ** 0.5
    assert noisy.beyond_noise(wrong, NOISE) == pytest.approx(clean, rel=0.2)


def test_frames_without_noise_hide_nothing():
    none = NoiseModel.white_only(torch.zeros(2), SHAPE)
    of_true = judge(TRUE)
    assert of_true.beyond_noise(WRONG, none) == pytest.approx(of_true.share(WRONG), rel=1e-9)
