"""One number of many estimates, some of which are wrong by more than they say."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

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
