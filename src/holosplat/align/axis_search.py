"""Search for the axis of sinograms and its tilt: likelihood of places, order by order of the moments."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..checks import require
from ..progress import Advance
from .combine import Estimate, combined
from .consistency import Consistency, Sinograms

FEWEST_SLICES = 4
"""Slices that a lean needs at least."""
LEANS = 24
"""Leans that are tried on either side of a first one."""


@dataclass(frozen=True)
class Search:
    """Residuals with the axis at each of T offsets.

    offsets: [T], evenly spaced [pixels]
    unexplained: [T, N, B] sums of squares of each order, in each slice
    freedom: [N] numbers in each of these sums
    octaves: [N] which octave each order belongs to
    heights: [B] of the slices [pixels]
    """

    offsets: np.ndarray
    unexplained: np.ndarray
    freedom: np.ndarray
    octaves: np.ndarray
    heights: np.ndarray

    @classmethod
    def of(cls, sinograms: Sinograms, near: float, reach: float, step: float, on_progress: Advance) -> Search:
        """Offsets within `reach` of `near`, `step` apart [pixels]."""
        count = max(2, int(np.ceil(reach / step)))
        offsets = near + step * np.arange(-count, count + 1)
        judge = Consistency(sinograms, float(np.abs(sinograms.positions).max() + np.abs(offsets).max()))
        found = []
        for t, offset in enumerate(offsets):
            found.append(judge.unexplained(float(offset)))
            on_progress((t + 1) / len(offsets))
        tiny = 1e-18 * float((sinograms.values**2).sum()) + 1e-300
        octaves = np.log2(judge.orders).astype(int)
        return cls(offsets, np.stack(found) + tiny, judge.freedom, octaves, sinograms.heights)

    def likeliest(self) -> tuple[float, float]:
        """The likeliest offset [pixels] and lean [columns a row], all orders together.

        Errors: `InputError` where the offset is at the end of those that were tried.
        """
        every = np.ones(len(self.octaves), dtype=bool)
        leans, curves = self._curves(every, 0.0)
        best = int(curves.min(1).argmin())
        at = int(curves[best].argmin())
        require(
            0 < at < len(self.offsets) - 1,
            "the projections tell no axis within the field; check the angles, or say where it is by --axis-column.",
        )
        return float(self.offsets[at]), float(leans[best])

    def found(self, lean: float) -> tuple[Estimate, Estimate | None]:
        """The offset [pixels] and, of enough slices, the lean [columns a row] near `lean`, with their errors.

        Each octave of orders gives its own; how they scatter says what noise alone does not (light that drifts, matter
        beyond the field). Errors: `InputError` where none of them has an optimum.
        """
        places, slopes = [], []
        for octave in np.unique(self.octaves):
            leans, curves = self._curves(self.octaves == octave, lean)
            best = int(curves.min(1).argmin())
            places.append(minimum(self.offsets, curves[best]))
            slopes.append(minimum(leans, curves.min(1)) if len(leans) > 1 else None)
        places, slopes = ([each for each in found if each is not None] for found in (places, slopes))
        require(bool(places), "the projections tell no axis; check the angles, or say where it is by --axis-column.")
        offset = combined(*np.array(places).T)
        return offset, combined(*np.array(slopes).T) if slopes else None

    def _curves(self, orders: np.ndarray, lean: float) -> tuple[np.ndarray, np.ndarray]:
        """Leans [L] about `lean`, and minus the logarithms of the likelihood [L, T] of offsets with each of them.

        Each order has a noise of its own, the same in all slices, which is not known: it is eliminated.
        """
        table, heights = self.unexplained[:, orders], self.heights
        half = 0.5 * float(np.ptp(heights)) if len(heights) >= FEWEST_SLICES else 0.0
        step = self.offsets[1] - self.offsets[0]
        leans = np.array([lean]) if half == 0 else lean + np.arange(-LEANS, LEANS + 1) * step / half
        count = len(heights) * self.freedom[orders]
        curves = []
        for slope in leans:
            sums = np.zeros(table.shape[:2])
            for b, height in enumerate(heights):
                sums += shifted(table[..., b], slope * height / step)
            curves.append(0.5 * (count * np.log(sums)).sum(1))
        return leans, np.array(curves)


def shifted(table: np.ndarray, by: float) -> np.ndarray:
    """Rows [T, N] of a table at `t + by`, linear between rows; beyond its ends, as there."""
    at = np.clip(np.arange(len(table)) + by, 0, len(table) - 1)
    low = np.minimum(at.astype(int), len(table) - 2)
    share = (at - low)[:, None]
    return (1 - share) * table[low] + share * table[low + 1]


def minimum(places: np.ndarray, curve: np.ndarray) -> tuple[float, float] | None:
    """The minimum of a curve through a parabola, and its standard error; None at an end, or where it does not bend."""
    best = int(curve.argmin())
    if not 0 < best < len(curve) - 1:
        return None
    left, middle, right = curve[best - 1 : best + 2]
    step, bend = places[1] - places[0], left - 2 * middle + right
    if bend <= 0:
        return None
    return float(places[best] + 0.5 * step * (left - right) / bend), float(step / np.sqrt(bend))
