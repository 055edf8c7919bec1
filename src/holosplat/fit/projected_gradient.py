"""Minimisation under bounds by the spectral projected gradient: no rates to choose, a gradient a step."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from ..checks import InputError

MEMORY = 8
"""Values of which the largest may not be exceeded (Birgin et al. 2000 take 10)."""
SHRINK = 0.25
"""What is left of a step that was too long."""
FIRST_MOVE = 0.1
"""The first step moves no value by more than this."""

Evaluate = Callable[[Tensor], tuple[float, Tensor]]
"""Value and gradient at a point."""


def spectral_projected_gradient(
    evaluate: Evaluate, start: Tensor, upper: float, steps: int, on_progress: Callable[[float], None]
) -> Tensor:
    """The best point with 0 ≤ x ≤ `upper` after `steps` evaluations from `start`; of any shape.

    Birgin, Martínez & Raydan (2000), section 2, along the projection arc: the value may rise for a while, but not
    above the last few. Step lengths of Barzilai & Borwein (1988), eqs. 5 and 6 in turn (Dai & Fletcher 2005).
    """
    point = best = start.clamp(0, upper)
    value, slope = evaluate(point)
    least, recent = value, [value]
    length = FIRST_MOVE / max(float(slope.abs().max()), torch.finfo(slope.dtype).tiny)
    for done in range(1, steps):
        on_progress(done / steps)
        trial = (point - length * slope).clamp_(0, upper)
        value, trial_slope = evaluate(trial)
        if not value <= max(recent):  # too long a step, or no number at all
            length *= SHRINK
            continue
        length = _next_length(trial - point, trial_slope - slope, length, long=done % 2 == 0)
        point, slope, recent = trial, trial_slope, [*recent[1 - MEMORY :], value]
        if value < least:
            best, least = trial, value
    if not least < float("inf"):
        raise InputError("the fit found no finite value of its objective; check the frames and the start for NaN.")
    return best


def _next_length(move: Tensor, change: Tensor, length: float, long: bool) -> float:
    """The step length after a `move` that changed the gradient by `change`."""
    curvature = float((move * change).sum())
    if curvature <= 0:
        return 2 * length
    return float(move.square().sum()) / curvature if long else curvature / float(change.square().sum())
