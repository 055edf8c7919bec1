"""Rings: faults that stay in their pixels in all projections, such as noise and dust of too few flats."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..checks import require

FEWEST = 8
"""Projections that must be there, or too much of the object would pass for what all have in common."""
WIDEST = 31
"""Columns of a line that may be taken for a fault, at most."""
DARKEST = 0.01
"""Relative intensity below which a pixel counts as so bright: its logarithm has no meaning."""


def fixed_pattern(frame: Callable[[int], np.ndarray], count: int, width: int) -> np.ndarray:
    """The factor [H, W], about 1, that all of `count` projections have in common in details finer than `width` columns.

    It is the exponential of the mean of `ln I - median(ln I)`, the median over `width` columns: what turns with the
    object is in other columns in every projection, and averages out; lines of the object along its own axis of rotation
    do not, and are taken for faults, too. So is done row by row in sinograms as in "ring removal" (Boin & Haibel 2006),
    here in relative frames [H, W], `frame(i)`, read one at a time. Errors: `InputError` for fewer than `FEWEST`
    projections, or a width that is not odd or beyond 3 to `WIDEST`.
    """
    from scipy.ndimage import median_filter  # which takes long to load

    require(
        3 <= width <= WIDEST and width % 2 == 1,
        f"rings must be an odd number of columns from 3 to {WIDEST}, but it is {width}; take 5.",
    )
    require(count >= FEWEST, f"rings need at least {FEWEST} projections, but there are {count}; leave --rings.")
    total = np.zeros(())
    for i in range(count):
        logarithm = np.log(np.maximum(frame(i), DARKEST))
        total = total + (logarithm - median_filter(logarithm, (1, width), mode="nearest"))
    return np.exp(total / count)
