"""The part of a report on the guess of a network, as data."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..checks import shaped
from ..geometry import Grid

UNSURE = 0.2
"""Spread from which on matter counts as guessed."""


@dataclass(frozen=True)
class GuessShown:
    """occupancy, found: [Z, Y, X] of the guess and of the reconstruction, both in units of the material's δ; spread:
    [Z, Y, X] standard deviation of guesses, or None; words: what the run began with, and why; of_copies: whether these
    guesses are of copies of the scene, mirrored and turned, and not without one of the views each."""

    occupancy: np.ndarray
    found: np.ndarray
    spread: np.ndarray | None
    grid: Grid
    words: str
    of_copies: bool = False

    def __post_init__(self) -> None:
        for name in ("occupancy", "found", "spread"):
            if getattr(self, name) is not None:
                shaped(name, np.asarray(getattr(self, name)), self.grid.shape)

    @property
    def unsure(self) -> float | None:
        """Share of the reconstructed matter where guesses differ by more than `UNSURE`; None without a spread."""
        if self.spread is None:
            return None
        matter = np.clip(self.found, 0, None, dtype=np.float64)
        return float(matter[self.spread > UNSURE].sum() / max(float(matter.sum()), np.finfo(float).tiny))
