"""The density behind a decaying spherical shock, as a profile of continuous matter."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ..checks import require
from ..ranges import Share, SomeShare, ranged
from .continuous import NODES, WEIGHTS

PIECES = 8
"""Pieces of a ray that are integrated one by one: with a tail of a twentieth, right to 1e-6 of the largest integral."""


@dataclass(frozen=True)
@ranged
class Blast:
    """Friedlander's wave, `(1 - x) exp(-x)` with `x = (1 - s) / tail`, behind a front at `s = 1`.

    One at the front and nothing before it (the jump), compression as far as `tail` behind it, and then rarefaction,
    of at most e⁻² of the jump (Friedlander 1946, Proc. R. Soc. A 186, 322; of pressure, and so of density where the
    shock is weak). Within `core_radius` there is nothing. `InputError` where that reaches the front.
    """

    tail: SomeShare = 0.15
    """Length behind the front after which compression ends, in units of the front's radius."""
    core_radius: Share = 0.0
    """Radius within which there is nothing, in units of the front's radius."""

    def __post_init__(self) -> None:
        require(
            self.core_radius < 1, f"core_radius must be below 1, the front's radius, but it is {self.core_radius:g}."
        )

    @property
    def reach(self) -> float:
        """1."""
        return 1.0

    @property
    def core(self) -> float:
        """None."""
        return 0.0

    @property
    def mass(self) -> float:
        """By Gauss and Legendre, piece by piece."""
        edges = np.linspace(self.core_radius, 1, PIECES + 1)
        half = 0.5 * np.diff(edges)[:, None]
        s = edges[:-1, None] + half * (1 + NODES)
        return float((half * WEIGHTS * self._wave(s) * 4 * math.pi * s**2).sum())

    def density(self, s2: np.ndarray) -> np.ndarray:
        """The profile."""
        return np.where((s2 < 1) & (s2 >= self.core_radius**2), self._wave(np.sqrt(s2)), 0.0)

    def chord(self, b2: np.ndarray) -> np.ndarray:
        """By Gauss and Legendre along the ray, from the core to the front in pieces."""
        inner = np.sqrt(np.maximum(self.core_radius**2 - b2, 0))
        half = 0.5 * (np.sqrt(np.maximum(1 - b2, 0)) - inner) / PIECES
        total = np.zeros_like(inner)
        for piece in range(PIECES):
            for node, weight in zip(NODES, WEIGHTS):
                total += 2 * weight * half * self._wave(np.sqrt(b2 + (inner + half * (2 * piece + 1 + node)) ** 2))
        return total

    def _wave(self, s: np.ndarray) -> np.ndarray:
        x = (1 - s) / self.tail
        return (1 - x) * np.exp(-np.maximum(x, 0))
