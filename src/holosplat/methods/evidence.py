"""Which of two objects the frames speak for, with their noise taken off."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass

import torch
from torch import Tensor

from ..optics.noise_model import NoiseModel
from .cross_validation import MissingMatter

DRAWS = 16
"""Of the noise, for what it leaves of the matter: a standard deviation by so many is right to a sixth."""
HIDDEN = 2.0
"""Standard deviations of what noise leaves of the matter that it may hide."""
SMALLEST = sys.float_info.min


@dataclass(frozen=True)
class Floor:
    """What noise leaves of a mean square: the mean, and the standard deviation from one noise to another."""

    mean: float
    deviation: float

    def taken_off(self, square: float) -> float:
        """What of a mean square is beyond noise; at least what noise may hide, for a fit follows some of it."""
        return max(square - self.mean, self.deviation)


class Evidence:
    """Judges objects by the frames of `judge`, which have the noise `noise`."""

    def __init__(self, judge: MissingMatter, noise: NoiseModel) -> None:
        self._judge, self._noise = judge, noise
        draws = [noise.drawn(seed) for seed in range(DRAWS)]
        self.matter = _floor([judge.of(draw) / judge.whole for draw in draws] if judge.whole > 0 else [0.0])
        self.contrast = _floor([float(draw.square().mean()) / judge.contrast for draw in draws])

    def left(self, predicted: Tensor) -> float:
        """What predicted frames [V, H, W] leave unexplained beyond noise: the geometric mean of the share of all matter
        and of that of the contrast. The one does not see fringes that are out of place, the other hardly sees how much
        matter there is."""
        matter, contrast = self._beyond(predicted)
        return math.sqrt(math.sqrt(matter * contrast))

    def share(self, predicted: Tensor) -> float:
        """The share of all matter alone."""
        return math.sqrt(self._beyond(predicted)[0])

    def missing(self, predicted: Tensor) -> float:
        """The same; 0 where noise may hide all of it."""
        matter, _ = self._beyond(predicted)
        return math.sqrt(matter) if matter > HIDDEN * self.matter.deviation else 0.0

    def sureness(self, first: Tensor, second: Tensor) -> float:
        """By how many standard deviations of the noise the `first` prediction [V, H, W] leaves less than the second.

        What is compared are the differences of both shares' squares, each over their sum. With residuals r and noise n
        the part of the noise in `|r₂|² - |r₁|²` is `2 n·(p₁ - p₂)`, in matter with Wiener's inverse before both.
        That a fit to the noise of both is as good is taken for granted. Zero for the same prediction.
        """
        judge, apart = self._judge, first.double() - second.double()
        one, two = (self._beyond(predicted) for predicted in (first, second))
        sums = [max(a + b, SMALLEST) for a, b in zip(one, two)]
        gain = sum((b - a) / both for a, b, both in zip(one, two, sums))
        there, moved, by_noise = max(judge.whole, SMALLEST), judge.matter(apart), list[float]()
        for seed in range(DRAWS):
            draw = self._noise.drawn(DRAWS + seed)
            matter = 2 * float((judge.matter(draw) * moved).mean()) / there
            contrast = 2 * float((draw * apart).mean()) / judge.contrast
            by_noise.append(matter / sums[0] + contrast / sums[1])
        error = math.sqrt(sum(value**2 for value in by_noise) / DRAWS)
        return gain / max(error, SMALLEST)

    def _beyond(self, predicted: Tensor) -> tuple[float, float]:
        """Squares of both shares that predicted frames leave beyond noise."""
        matter, contrast = self._judge.squares(self._judge.measured - predicted)
        return self.matter.taken_off(matter), self.contrast.taken_off(contrast)


def _floor(squares: list[float]) -> Floor:
    found = torch.tensor(squares, dtype=torch.float64)
    return Floor(float(found.mean()), float(found.std(correction=0)))
