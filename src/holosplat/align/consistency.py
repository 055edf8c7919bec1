"""Consistency of projections of one rotating body: their moments are trigonometric polynomials of the angle.

For a slice of the body with projections p(θ, s), `∫ p(θ, s) U_n(s) ds` is a trigonometric polynomial in θ, of degree n
and of n's parity (Helgason 1980, *The Radon Transform*; Ludwig 1966, "The Radon transform on Euclidean space"). So
no reconstruction is needed to test the place of the rotation axis.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..inference import Compared

FEWEST_SAMPLES = 5.0
"""Columns for a half wave of the highest order, at least: higher orders are hardly sampled, and see noise."""
LOWEST = 4
"""The lowest order that is judged, where there are others: light that drifts is taken for matter in lower ones."""
FREE_VIEWS = 1 / 3
"""Share of the views that an order must leave for judging, beside its polynomial."""


@dataclass(frozen=True)
class Sinograms:
    """Projections of slices.

    values: [V, B, W] float64, of B slices
    angles: [V] [rad]
    positions: [V, W] or [1, W] of the columns' centres, from the nominal axis [pixels]
    heights: [B] of the slices along the axis [pixels]
    """

    values: np.ndarray
    angles: np.ndarray
    positions: np.ndarray
    heights: np.ndarray

    def binned(self, factor: int) -> Sinograms:
        """Columns averaged `factor` by `factor`; what is left over at the end is dropped. Lengths stay in pixels."""
        count = self.values.shape[-1] // factor
        values, positions = (
            array[..., : count * factor].reshape(*array.shape[:-1], count, factor).mean(-1)
            for array in (self.values, self.positions)
        )
        return Sinograms(values, self.angles, positions, self.heights)


class Consistency:
    """How far projections are from those of one turning body, if the axis lies elsewhere than said."""

    def __init__(self, sinograms: Sinograms, reach: float) -> None:
        """reach: the farthest from the axis that any column lies, wherever the axis is looked for [pixels]."""
        self._of, self._reach = sinograms, reach
        views, width = len(sinograms.angles), sinograms.values.shape[-1]
        step = float(np.abs(np.diff(sinograms.positions[0])).mean())
        highest = int(np.pi * reach / (FEWEST_SAMPLES * step))
        lowest = LOWEST if views >= 2 * LOWEST else 2
        spaces = [polynomials(n, sinograms.angles) for n in range(lowest, max(lowest, min(highest, width)) + 1)]
        self._spaces = [space for space in spaces if space.shape[1] <= max((1 - FREE_VIEWS) * views, lowest + 2)]
        self.orders = np.arange(lowest, lowest + len(self._spaces))
        self.freedom = np.array([views - space.shape[1] for space in self._spaces])

    def unexplained(self, offset: float) -> np.ndarray:
        """Sums of squares [N, B] of each order that no body explains, with the axis at `offset` [pixels]."""
        inside = np.clip((self._of.positions - offset) / self._reach, -1, 1)
        values, found = self._of.values, np.empty((len(self.orders), self._of.values.shape[1]))
        half, sines = np.arccos(inside), np.sqrt(np.maximum(1 - inside**2, 1e-12))
        for i, (n, space) in enumerate(zip(self.orders, self._spaces)):
            weights = np.sin((n + 1) * half) / sines  # U_n(cos t) = sin((n + 1) t) / sin t
            moments = values @ weights[0] if len(weights) == 1 else np.einsum("vbw,vw->vb", values, weights)
            found[i] = ((moments - space @ (space.T @ moments)) ** 2).sum(0)
        return found


def polynomials(order: int, angles: np.ndarray) -> np.ndarray:
    """Orthonormal columns [V, K] of the trigonometric polynomials that moments of this order are, and a constant.

    The constant stands for what all frames have in common, such as dust on a single flat field; it costs the centre of
    mass, whose sinusoid would tell the axis where frames have no such faults, but leaves all other orders.
    """
    waves = np.arange(order % 2, order + 1, 2)
    columns = [np.cos(m * angles) for m in waves] + [np.sin(m * angles) for m in waves if m > 0]
    if order % 2:
        columns.append(np.ones_like(angles))
    left, sizes, _ = np.linalg.svd(np.stack(columns, axis=1), full_matrices=False)
    return left[:, sizes > 1e-9 * sizes[0]]


ROUNDS = 20
"""Rounds in which scatter and mean are found from each other; they settle in fewer."""
FAR = 3.0
"""Estimates farther from the mean than so many of their deviations count for less (Huber 1964)."""
NORMAL = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""


@dataclass(frozen=True)
class Estimate:
    """A number and its standard error."""

    value: float
    error: float

    def compared(self, name: str) -> Compared:
        """The hypothesis `name`, that the number is not zero: the logarithm of its likelihood ratio `z²/2`, whose
        standard deviation is |z|, the number over its error (Cox 1961, Proc. 4th Berkeley Symp. 1, 105)."""
        z = abs(self.value) / max(self.error, 1e-300)
        return Compared(name, 0.5 * z**2, z)


def combined(values: np.ndarray, errors: np.ndarray) -> Estimate:
    """The mean of K estimates with their standard errors, and its own: they also differ by what no error tells.

    The scatter beyond the errors is the same for all (random effects, DerSimonian & Laird 1986), and taken of the
    median, so that a few estimates may be altogether wrong.
    """
    mean, scatter = _median(values, 1 / errors**2), 0.0
    for _ in range(ROUNDS):
        away = np.abs(values - mean)
        scatter = float(np.sqrt(max(NORMAL**2 * _median(away, np.ones_like(away)) ** 2 - np.median(errors) ** 2, 0.0)))
        weights = 1 / (errors**2 + scatter**2)
        weights = weights * np.minimum(1, FAR / np.maximum(away * np.sqrt(weights), 1e-12)) ** 2
        mean = float((weights * values).sum() / weights.sum())
    return Estimate(mean, float(1 / np.sqrt(weights.sum())))


def _median(values: np.ndarray, weights: np.ndarray) -> float:
    """The weighted median, linear between values."""
    order = np.argsort(values)
    share = np.cumsum(weights[order]) - 0.5 * weights[order]
    return float(np.interp(0.5 * weights.sum(), share, values[order]))
