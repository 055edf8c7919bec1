"""Diagnosis of a misfit: score tests of the changes that `residuals` probed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .residuals import COMMON, SMALLEST, Probe, Residuals

EACH_VIEW = {"shifts": slice(4, 6), "light": slice(len(COMMON), None)}
"""Changes that differ between views, and where a probe has them."""
PLAUSIBLE = {
    "mass": (-0.9, 2.0),
    "absorption": (-1.0, 1.0),
    "distance": (-0.9, 2.0),
    "blur": (-4.0, 4.0),
    "shift_x": (-4.0, 4.0),
    "shift_y": (-4.0, 4.0),
}
"""Least and largest change that is believed: shares of matter and distance, pixels² of blur, pixels of shifts."""
SIMPLER = 0.9
"""A change that all views share is preferred where it gains this part of what one gains that differs between views."""
SMALLEST_EIGENVALUE = 1e-6
"""Share of the largest below which directions of a view's changes are left out."""


@dataclass(frozen=True)
class Cause:
    """A change that would explain some of a residual.

    name: one of `COMMON`, or of `EACH_VIEW`
    value: [n] the change: of matter and distance a share, of blur the variance [pixels²], of shifts pixels; or [K, n]
        that of each probed view: shifts along x and y [pixels], or coefficients of the light's modes
    error: the standard error of each, if the residual were what is allowed
    gain: the drop of χ² beyond what chance would give
    share: the gain as a share of the residual's excess over what is allowed
    significance: the gain in standard deviations of chance
    """

    name: str
    value: np.ndarray
    error: np.ndarray
    gain: float
    share: float
    significance: float


def excess(found: Residuals) -> float:
    """How much χ² of the probed views exceeds the number of coefficients, summed over the bands in which it does."""
    ratio = found.residual[found.probed] / np.maximum(found.allowed[found.probed], SMALLEST)
    return float(np.maximum((ratio - 1).sum(axis=0) * found.rings.counts, 0.0).sum())


def cause_scores(found: Residuals) -> dict[str, Cause]:
    """Each change tested by itself: the step to the minimum of χ², whose derivatives the probes hold.

    This is Rao's score test (Rao 1948), with the derivatives by finite differences. The object has already absorbed
    what it could, so that the change of a constant that it imitates is underestimated.
    """
    left = [probe.product for probe in found.probes]
    return {cause.name: cause for cause in _tested(found, left)}


def likely_causes(found: Residuals, least: float = 0.1, most: int = 3) -> list[Cause]:
    """At most `most` causes, one after another: that which takes away most of what those before it left.

    Those that take away less than the share `least` of the excess are left out.
    """
    left, named = [probe.product.copy() for probe in found.probes], list[Cause]()
    while len(named) < most:
        others = [c for c in _tested(found, left) if c.name not in [n.name for n in named]]
        best = max(others, key=lambda cause: cause.gain * (SIMPLER if cause.name in EACH_VIEW else 1.0))
        if best.share < least:
            break
        named.append(best)
        at = _place(best.name)
        steps = np.broadcast_to(best.value, (len(left), best.value.shape[-1]))
        for probe, product, step in zip(found.probes, left, steps):
            product -= probe.gram[:, at] @ step
    return named


def _place(name: str) -> slice:
    return EACH_VIEW[name] if name in EACH_VIEW else slice(COMMON.index(name), COMMON.index(name) + 1)


def _tested(found: Residuals, left: Sequence[np.ndarray]) -> list[Cause]:
    over = max(excess(found), 1.0)
    common = [_of_all(name, found.probes, left, over) for name in COMMON]
    return common + [_of_each(name, found.probes, left, over) for name in EACH_VIEW]


def _of_all(name: str, probes: Sequence[Probe], left: Sequence[np.ndarray], over: float) -> Cause:
    at = COMMON.index(name)
    gram = max(sum(float(probe.gram[at, at]) for probe in probes), SMALLEST)
    product = sum(float(one[at]) for one in left)
    value = float(np.clip(product / gram, *PLAUSIBLE[name]))
    drop = max(value * (2 * product - value * gram), 0.0)
    gain = max(drop - 1, 0.0)
    return Cause(name, np.array([value]), np.array([gram**-0.5]), gain, gain / over, drop**0.5)


def _of_each(name: str, probes: Sequence[Probe], left: Sequence[np.ndarray], over: float) -> Cause:
    at, values, errors, drop, free = _place(name), list[np.ndarray](), list[np.ndarray](), 0.0, 0
    for probe, one in zip(probes, left):
        inverse = np.linalg.pinv(probe.gram[at, at], rcond=SMALLEST_EIGENVALUE, hermitian=True)
        values.append(inverse @ one[at])
        errors.append(np.sqrt(np.diag(inverse).clip(0)))
        drop += float(one[at] @ values[-1])
        free += len(one[at])
    gain = max(drop - free, 0.0)
    return Cause(name, np.array(values), np.array(errors), gain, gain / over, (drop - free) / (2 * free) ** 0.5)
