"""Foam: bubbles of many sizes in a drop of liquid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr, ndtri

from ..checks import in_range, require
from .phantoms import Ball, packed_balls

CUT = 2.0
"""Diameters further than this from the median, in standard deviations of their logarithm, are not drawn."""


@dataclass(frozen=True, eq=False)
class Foam:
    """A drop about the origin, and the bubbles inside it, which touch neither each other nor its surface."""

    drop: Ball
    bubbles: tuple[Ball, ...]

    @property
    def liquid_volume(self) -> float:
        """The drop's volume without its bubbles' [m³]."""
        return self.drop.volume - sum(bubble.volume for bubble in self.bubbles)


def random_foam(
    drop: float,
    count: int,
    median: float,
    spread: float = 0.4,
    margin: float | None = None,
    seed: int | np.random.Generator = 0,
) -> Foam:
    """A spherical drop of diameter `drop` [m] with `count` bubbles of log-normal diameters at random in it.

    median: of the bubbles' diameters [m]; spread: standard deviation of their natural logarithm (drawn within two
    of them); margin: thinnest film of liquid [m], by default 5 % of the median. `InputError` when they do not fit.
    """
    whole = isinstance(count, (int, np.integer)) and count >= 1
    require(whole, f"the number of bubbles must be a whole number of at least 1, but it is {count!r}.")
    in_range("median diameter", median, 1e-9, 1.0, unit="metres")
    require(0 <= spread <= 1, f"spread must lie between 0 and 1, but it is {spread!r}.")
    rng = np.random.default_rng(seed)
    deviates = ndtri(rng.uniform(ndtr(-CUT), ndtr(CUT), count))
    margin = 0.05 * median if margin is None else margin
    bubbles = packed_balls(median * np.exp(spread * deviates), (drop, drop, drop), rng, margin, "ball")
    return Foam(Ball(np.zeros(3), drop), tuple(bubbles))
