"""Model comparison for two beams: bodies tracked as red cells, and as bodies of any shape.

Two beams leave shapes open, and bodies of unknown shape stay poor in them, while red cells are found by their shape at
rest. Where a network that knows red cells alone guesses bodies that frames do not contradict, cells of that size are
looked for: the null. Bodies of any shape, which are freer, must explain the frames better (`inference.select`).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch

from ..checks import InputError, as_written
from ..inference import Score, select
from .body_tracker import BodyTracker, Followed
from .journal import Journal
from .residual_detection import predicted

NAME, CELLS, ANY = "shape of the bodies", "red cells", "any shape"


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


def compared_kinds(cells: BodyTracker, other: BodyTracker) -> Followed:
    """What `cells`, of red cells, found, or `other`, of bodies of any shape, which has its sightings.

    Errors: those of either; where there are no cells of that size, of `other` alone.
    """
    if cells.stage == "sightings":
        cells.seen, cells.counts, cells.guess, cells.stage = other.seen, other.counts, other.guess, "first paths"
        cells.decisions = list(other.decisions)
    try:
        cells.until("stiff")
    except InputError:  # no cell of that size
        other.until("done")
        return other.followed("; no red cells of their size were found")
    cells.until("halves")
    other.until("halves")
    scores = {CELLS: unexplained(cells), ANY: unexplained(other)}
    decision = select(NAME, tuple(scores), lambda name, fold: scores[name], by="training frames")
    kept = cells if decision.choice == CELLS else other
    kept.decisions = [*(each for each in kept.decisions if each.name != NAME), decision]
    kept.until("done")
    return kept.followed()


def unexplained(of: BodyTracker) -> Score:
    """The residual of the training frames with the bodies."""
    assert of.bodies is not None
    return Score.of(torch.from_numpy(of.train.frames - predicted(of.train, of.bodies, of.oversample)))
