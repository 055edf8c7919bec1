"""Whether what two beams show are red cells: bodies are followed as such, and as bodies of any shape.

Two beams leave shapes open, and bodies of unknown shape stay poor in them, while red cells are found by their shape at
rest. Where a network that knows red cells alone guesses bodies that frames do not contradict, cells of that size are
looked for. They are kept where they explain the frames to their noise, or leave no more than bodies of any shape do:
these are freer, so that of other bodies they leave less.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from ..checks import InputError, as_written
from ..fit.residuals import Prediction
from ..optics.noise import noise_levels
from ..representations import MovingSurfaces
from ..scan import Scan
from .following import Followed, Following
from .journal import Journal

EXPLAINED = 1.05
"""Residual over noise, root mean squares, up to which frames are explained and no other shapes are tried."""


TINY = 1e-12
"""Noise that is divided by at least."""


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
        """What was saved last of one of them."""
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
        """What was saved last; None at the beginning."""
        return self._parts.load(self._name)

    def save(self, state: Mapping[str, Any]) -> None:
        """Keep it."""
        self._parts.save(self._name, state)


def cells_or_any(cells: Following, other: Following) -> Followed:
    """What `cells`, of red cells, found, or `other`, of bodies of any shape, which has its sightings.

    Errors: those of `other`, where there are no cells.
    """
    if cells.stage == "sightings":
        cells.seen, cells.counts, cells.guess, cells.stage = other.seen, other.counts, other.guess, "first paths"
    try:
        cells.until("halves")
        left = residual(cells)
    except InputError:  # no cell of that size
        other.until("done")
        return other.followed("; no red cells of their size were found")
    said = f"; as red cells of their size they leave {left:.2f} times the noise of the frames"
    if left > EXPLAINED:
        other.until("halves")
        beside = residual(other)
        said += f", as bodies of any shape {beside:.2f} times"
        if beside < left:
            other.until("done")
            return other.followed(f"{said}, and are followed as such")
    cells.until("done")
    return cells.followed(f"{said}, and are followed as cells")


def residual(of: Following) -> float:
    """What its bodies leave of the frames over the frames' noise, root mean squares."""
    assert of.bodies is not None
    left = measured_less_predicted(of.train, of.bodies, of.oversample)
    noise = float(noise_levels(torch.from_numpy(of.train.frames)).square().mean().sqrt())
    return float(np.sqrt(np.mean(left**2))) / max(noise, TINY)


def measured_less_predicted(train: Scan, bodies: MovingSurfaces, oversample: int) -> np.ndarray:
    """[N, H, W]."""
    said = Prediction(bodies, train.exposures, oversample)
    with torch.no_grad():
        return np.stack([train.frames[v] - said.view(v).frames()[0].numpy() for v in range(len(train))])
