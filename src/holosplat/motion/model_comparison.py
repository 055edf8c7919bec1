"""Model comparison for two beams: bodies tracked as red cells, and as bodies of any shape.

Two beams leave shapes open, and bodies of unknown shape stay poor in them, while red cells are found by their shape at
rest. Where a network that knows red cells alone guesses bodies that frames do not contradict, cells of that size are
looked for. They are kept unless bodies of any shape, which are freer, leave clearly less of the frames.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ..checks import InputError, as_written
from ..units import in_percent
from .body_tracker import Followed, Following
from .journal import Journal
from .residual_detection import predicted

CLEARLY = 0.95
"""What bodies of any shape must leave of what cells leave: so much freer in two beams, they follow noise and explain by
ghosts what they miss."""
TINY = 1e-12
"""Contrast that is divided by at least."""


class Parts:
    """A journal of several followings, each by its name."""

    def __init__(self, journal: Journal) -> None:
        self._journal = journal
        with as_written("checkpoint.pt", "a checkpoint of this run"):
            self._states = dict[str, Mapping[str, Any]](journal.load() or {})

    def of(self, name: str) -> Part:
        """The journal of one of them."""
        return Part(self, name)

    def load(self, name: str) -> Mapping[str, Any] | None:
        """Load the last saved state of one of them."""
        return self._states.get(name)

    def save(self, name: str, state: Mapping[str, Any]) -> None:
        """Keep it, beside those of the others."""
        self._states[name] = state
        self._journal.save(self._states)


class Part:
    """The journal of one following of several."""

    def __init__(self, parts: Parts, name: str) -> None:
        self._parts, self._name = parts, name

    def load(self) -> Mapping[str, Any] | None:
        """Load the last saved state; None at the beginning."""
        return self._parts.load(self._name)

    def save(self, state: Mapping[str, Any]) -> None:
        """Keep it."""
        self._parts.save(self._name, state)


def cells_or_any(cells: Following, other: Following) -> Followed:
    """What `cells`, of red cells, found, or `other`, of bodies of any shape, which has its sightings.

    Errors: those of either; where there are no cells of that size, of `other` alone.
    """
    if cells.stage == "sightings":
        cells.seen, cells.counts, cells.guess, cells.stage = other.seen, other.counts, other.guess, "first paths"
    try:
        cells.until("stiff")
    except InputError:  # no cell of that size
        other.until("done")
        return other.followed("; no red cells of their size were found")
    cells.until("halves")
    other.until("halves")
    left, beside = residual(cells), residual(other)
    said = f"; as red cells of their size they leave {in_percent(left)} of the contrast, as bodies of any shape "
    said += f"{in_percent(beside)}, and are followed as "
    kept, name = (other, "such") if beside < CLEARLY * left else (cells, "cells")
    kept.until("done")
    return kept.followed(said + name)


def residual(of: Following) -> float:
    """Residual of the frames over their contrast, root mean squares."""
    assert of.bodies is not None
    frames = of.train.frames
    left = frames - predicted(of.train, of.bodies, of.oversample)
    return float(np.linalg.norm(left) / max(float(np.linalg.norm(frames - 1)), TINY))
