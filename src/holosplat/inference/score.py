"""The predictive score: how much of measured frames a prediction leaves, octave by octave and block by block."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from torch import Tensor

BLOCK = 32
"""Edge of the blocks [pixels], at most, whose scatter gives the standard error within a frame: on frames of some 80
pixels, residuals correlate over the bodies that cause them."""
SMALLEST = 1e-12
"""Part of the largest power that every power has at least, against the logarithm of zero."""


@dataclass(frozen=True)
class Score:
    """What a prediction leaves of frames that it has not seen.

    powers: [B, K] float64: mean square residual of each of B blocks in each of K octaves of spatial frequency, the
    finest first; the last octave holds everything coarser than a block
    frames: number of frames, of which each has B / frames blocks
    """

    powers: np.ndarray
    frames: int = 1

    @classmethod
    def of(cls, residual: Tensor) -> Score:
        """Of residuals [V, H, W]: powers of the Haar wavelets (Haar 1910) in square blocks of `BLOCK` pixels.

        The wavelets of a block lie within it, so that blocks share nothing. Small frames have smaller blocks; what
        remains of rows and columns is left out at both sides.
        """
        import torch

        edge = BLOCK
        while edge > 2 and min(residual.shape[1:]) < 2 * edge:
            edge //= 2
        if min(residual.shape[1:]) < edge:
            edge = 1
        rows, columns = (slice((n % edge) // 2, (n % edge) // 2 + n // edge * edge) for n in residual.shape[1:])
        level = residual.detach().cpu().double()[:, rows, columns]
        bands: list[Tensor] = []
        size = edge
        while size > 1:
            quads = level.unflatten(2, (-1, 2)).unflatten(1, (-1, 2))
            mean = quads.mean(dim=(2, 4))
            detail = (quads - mean[:, :, None, :, None]).square().sum(dim=(2, 4)) / 3
            half = size // 2
            bands.append(torch.nn.functional.avg_pool2d(detail[None], half)[0].flatten() * (edge // size) ** 2)
            level, size = mean, half
        bands.append(level.square().flatten() * edge**2)
        return cls(torch.stack(bands, dim=1).numpy(), len(residual))

    @classmethod
    def joined(cls, scores: Sequence[Score]) -> Score:
        """The score of several sets of frames, with one block a frame; of one set the same."""
        if len(scores) == 1:
            return scores[0]
        whole = [one.powers.reshape(one.frames, -1, one.powers.shape[1]).mean(axis=1) for one in scores]
        return cls(np.concatenate(whole), sum(one.frames for one in scores))

    def gain_over(self, other: Score) -> tuple[float, float]:
        """How much smaller the residual is than that of `other`, and the standard error of this.

        The gain is the log-likelihood with the variance of each octave profiled, `½ log P`, in the mean over octaves:
        the logarithm of the ratio of residuals. Octaves count alike, whereas pixels are nearly all of the finest one,
        and matter shows itself in all. The error is that of the delete-one jackknife (Efron & Stein 1981) over blocks,
        of the paired difference.
        """
        mine, theirs = (one.powers for one in (self, other))
        sums = mine.sum(axis=0), theirs.sum(axis=0)
        gain = float(self._log_ratio(*sums))
        count = len(mine)
        if count < 2:
            return gain, float("inf")
        without = self._log_ratio(sums[0] - mine, sums[1] - theirs)
        error = float(np.sqrt((count - 1) / count * np.square(without - without.mean()).sum()))
        return gain, error

    def _log_ratio(self, mine: np.ndarray, theirs: np.ndarray) -> np.ndarray:
        return 0.5 * np.log(self._means(theirs) / self._means(mine)).mean(axis=-1)

    @staticmethod
    def _means(powers: np.ndarray) -> np.ndarray:
        largest = powers.max(axis=-1, keepdims=True)
        return np.maximum(powers, np.maximum(SMALLEST * largest, np.finfo(float).tiny))
