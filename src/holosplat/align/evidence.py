"""Shrinkage of pose estimates towards the plan by their evidence; undetermined parts stay as planned."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .untold import beside

STRONG = 3.0
"""Logarithm of the ratio of evidences from which a plan counts as wrong: 20 to 1, strong (Kass & Raftery 1995)."""
SCALES = (0.0, 1 / 32, 1 / 16, 1 / 8, 1 / 4, 1 / 2, 1.0)
"""Sizes of the plan's errors, as shares of what is uncertain, that are tried."""
SWEEPS = 3
"""Times that the size of each kind's errors is chosen beside those of the others."""


@dataclass(frozen=True)
class Weighed:
    """Estimates of K parameters of each of V views.

    numbers: [V, K] as far as the frames determine them
    covariance: [V · K, V · K] of what was found, with what is uncertain as the prior
    off: [V · K, V · K] mean squares and products of what `numbers` are off by: the covariance, and how far they are
        from the likeliest with this prior, for what stays as planned may be as wrong as the estimates indicate
    scales: of each kind of numbers, the likeliest size of the plan's errors as a share of what is uncertain
    """

    numbers: np.ndarray
    covariance: np.ndarray
    off: np.ndarray
    scales: tuple[float, ...]


def weighed(
    found: np.ndarray,
    information: np.ndarray,
    expected: np.ndarray,
    kinds: list[list[int]],
    motions: np.ndarray,
) -> Weighed:
    """The likeliest parameters of V views, with errors of the plan of the size of largest evidence.

    found: [V, K]; information: [V · K, V · K] of them, beside matter that is not known; expected: [K] their standard
    deviations; kinds: the places of those that are wrong by the same share of these; motions: [V · K, M] what common
    motions do to all, which no frame determines and which are left out.

    With found numbers normal about the true ones, and these about the plan, the evidence of a size of the plan's errors
    has a closed form (MacKay 1992). The largest is taken; for each kind with errors it must be larger by `STRONG`. Each
    combination of parameters then shrinks to the plan as far as the frames do not determine it.
    """
    units = np.tile(expected, len(found))
    kept = beside(motions / units[:, None])
    scaled = _project_out(units[:, None] * information * units, motions / units[:, None])
    told, values = kept.T @ scaled @ kept, kept.T @ (found.reshape(-1) / units)
    shares = np.zeros((len(kinds), found.size))
    for row, places in zip(shares.reshape(len(kinds), *found.shape), kinds):
        row[:, places] = 1

    def spread_of(scales: tuple[float, ...]) -> np.ndarray:
        return (kept.T * (np.square(scales) @ shares)) @ kept

    def gain(scales: tuple[float, ...]) -> float:
        return _evidence(told, values, spread_of(scales)) - STRONG * np.count_nonzero(scales)

    scales = (1.0,) * len(kinds)
    for k in list(range(len(kinds))) * SWEEPS:
        scales = max((scales[:k] + (tried,) + scales[k + 1 :] for tried in SCALES), key=gain)
    spread = spread_of(scales)
    shrunk = spread @ np.linalg.solve(told @ spread + np.eye(len(told)), told @ values)
    whole = np.linalg.inv(told + np.eye(len(told)))
    away = whole @ told @ values - shrunk
    covariance, off = (
        units[:, None] * (kept @ part @ kept.T) * units for part in (whole, whole + np.outer(away, away))
    )
    return Weighed((units * (kept @ shrunk)).reshape(found.shape), covariance, off, scales)


def _evidence(told: np.ndarray, values: np.ndarray, spread: np.ndarray) -> float:
    """Log density, up to a constant, of `values`, whose errors have the information `told`, about 0 ± `spread`."""
    both = told @ spread + np.eye(len(told))
    return float(-0.5 * np.linalg.slogdet(both)[1] - 0.5 * values @ np.linalg.solve(both, told @ values))


def _project_out(information: np.ndarray, motions: np.ndarray) -> np.ndarray:
    """Information of what is left when the best of all `motions` is taken out."""
    across = information @ motions
    return information - across @ np.linalg.pinv(motions.T @ across, rcond=1e-9, hermitian=True) @ across.T
