"""Minimisation under bounds by the spectral projected gradient: no rates to choose, a gradient a step."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from ..checks import InputError, require
from .optimiser import Leaves

MEMORY = 8
"""Values of which the largest may not be exceeded (Birgin et al. 2000 take 10)."""
SHRINK = 0.25
"""Factor that shortens a step that was too long."""
FIRST_MOVE = 0.1
"""The first step moves no value by more than this."""


class ProjectedGradient:
    """An `Optimiser` of one parameter that keeps lower ≤ x ≤ upper and needs the whole objective in every step.

    Birgin, Martínez & Raydan (2000), section 2, along the projection arc: the value may rise for a while, but not
    above the last few. Step lengths of Barzilai & Borwein (1988), eqs. 5 and 6 in turn (Dai & Fletcher 2005). After a
    step, the leaf is the next point to be tried; `best` has the best one so far. upper, lower: the
    bounds, or infinite; scale: units of the parameter in which steps are equally long, broadcast to its shape.
    """

    def __init__(self, leaves: Leaves, upper: float, scale: Tensor | None = None, lower: float = 0.0) -> None:
        require(len(leaves) == 1, f"a projected gradient moves one parameter, but {', '.join(leaves)} are free.")
        (self._name,) = leaves
        self._leaves, self._bounds = leaves, (lower, upper)
        self._scale = torch.ones(()) if scale is None else scale
        self._begin()

    def _begin(self) -> None:
        leaf = self._leaves[self._name]
        with torch.no_grad():
            leaf.copy_((leaf / self._scale).clamp(*self._bounds) * self._scale)
        self._point: Tensor | None = None
        self._slope, self._best = torch.empty(0), leaf.detach() / self._scale
        self._recent: list[float] = []
        self._least, self._length, self._done = float("inf"), 0.0, 0

    def prepare(self, rates: Mapping[str, float]) -> None:
        """No columns: there are no rates."""

    @torch.no_grad()
    def apply(self, loss: Tensor) -> None:
        """Judge the leaf by its loss, accept or shorten the step, and make the leaf the next point to be tried."""
        leaf, value = self._leaves[self._name], float(loss)
        assert leaf.grad is not None
        trial, slope = leaf.detach() / self._scale, leaf.grad * self._scale
        leaf.grad = None
        if self._point is None:
            self._length = FIRST_MOVE / max(float(slope.abs().max()), torch.finfo(slope.dtype).tiny)
            self._accept(trial, slope, value)
        elif not value <= max(self._recent):  # too long a step, or no number at all
            self._length *= SHRINK
        else:
            long = self._done % 2 == 0
            self._length = _next_length(trial - self._point, slope - self._slope, self._length, long)
            self._accept(trial, slope, value)
        self._done += 1
        assert self._point is not None
        leaf.copy_((self._point - self._length * self._slope).clamp_(*self._bounds) * self._scale)

    def _accept(self, point: Tensor, slope: Tensor, value: float) -> None:
        self._point, self._slope, self._recent = point.clone(), slope.clone(), [*self._recent[1 - MEMORY :], value]
        if value < self._least:
            self._best, self._least = self._point, value

    @property
    def settled(self) -> bool:
        """Never: its steps are counted."""
        return False

    def best(self) -> Leaves:
        """The point with the least value; `InputError` if no value was finite."""
        if not self._least < float("inf"):
            raise InputError("the fit found no finite value of its objective; check the frames and the start for NaN.")
        return {self._name: self._best * self._scale}

    def resize(self, names: list[str], keep: Tensor, added: Mapping[str, Tensor]) -> None:
        """Begin anew from the resized leaf."""
        self._begin()

    def state_dict(self) -> dict[str, Any]:
        """See `Optimiser`."""
        arrays = {"slope": self._slope, "best": self._best, "point": self._point}
        numbers = {"recent": self._recent, "least": self._least, "length": self._length, "done": self._done}
        return {name: None if a is None else a.cpu().clone() for name, a in arrays.items()} | numbers

    def load(self, state: dict[str, Any]) -> None:
        """See `Optimiser`."""
        self._slope, self._best, self._point = state["slope"], state["best"], state["point"]
        self._recent, self._least = list(state["recent"]), float(state["least"])
        self._length, self._done = float(state["length"]), int(state["done"])


def _next_length(move: Tensor, change: Tensor, length: float, long: bool) -> float:
    """The step length after a `move` that changed the gradient by `change`."""
    curvature = float((move * change).sum())
    if curvature <= 0:
        return 2 * length
    return float(move.square().sum()) / curvature if long else curvature / float(change.square().sum())
