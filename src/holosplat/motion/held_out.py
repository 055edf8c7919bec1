"""Frames that are held out for a moment, and how long a volume is fitted by what they say."""

from __future__ import annotations

import numpy as np
from torch import Tensor

from ..fit.flow_volume import FlowProblem
from ..fit.smooth_volume import Descent

WINDOW, PATIENCE = 10, 3
"""Iterations from one look at held-out frames to the next, and looks without a better one after which the fit ends."""


def kept_frames(times: int, views: int, held_out: int, seed: int) -> np.ndarray:
    """[T, V] bool: all frames but one in `held_out`, drawn at random; one a time at least."""
    aside = np.zeros(times * views, dtype=bool)
    aside[np.random.default_rng(seed).permutation(times * views)[: times * views // held_out]] = True
    keep = ~aside.reshape(times, views)
    keep[~keep.any(1), 0] = True
    return keep


def iterations_that_predict(kept: FlowProblem, aside: FlowProblem, u: Tensor, most: int) -> tuple[int, float]:
    """How many iterations from `u` [Z, Y, X] on, fitted to the frames `kept`, predict those `aside` best; and what that
    takes from ½ χ² of these, beside the first look.

    A volume that follows noise predicts other frames worse, so the end of the fit is where the data put it (early
    stopping; Prechelt 1998), and not where the objective has its minimum. `most`: of them, at most.
    """
    descent, first = Descent(kept, u), min(WINDOW, most)
    best, least, begun = 0, np.inf, np.inf
    while descent.done < most and not descent.ended:
        descent.step()
        if descent.done % WINDOW and descent.done < most and not descent.ended:
            continue
        missed = sum(aside.misfit(descent.u))
        begun = missed if descent.done <= first else begun
        if missed < least:
            best, least = descent.done, missed
        elif descent.done >= best + PATIENCE * WINDOW:
            break
    return max(best, 1), float(begun - least) if best else 0.0
