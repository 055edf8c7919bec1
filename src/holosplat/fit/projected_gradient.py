"""Minimisation with no rates to choose: under bounds by the spectral projected gradient, a gradient a step; and by
L-BFGS, along the gradient as past steps have bent it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
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


SUFFICIENT = 1e-4
"""Share of the decrease that the slope promises which a step must bring."""
LEAST_SHRINK, MOST_SHRINK = 0.1, 0.5
"""Smallest and largest factor that shortens a step that was too long."""
LONGER = 10.0
"""How much longer than the first step any other may be."""
BENT = 1e-10
"""Cosine between a step and the change of the gradient from which on the pair is believed."""
WINDOW = 10
"""Steps over which the gain is looked at."""

Pairs = Sequence[tuple[Tensor, Tensor]]
"""Steps, and what they changed of the gradient, the latest last."""


def direction(
    gradient: Tensor, pairs: Pairs, inverse: Callable[[Tensor], Tensor], free: Tensor | None = None
) -> Tensor:
    """Minus the inverse second derivative, as L-BFGS knows it, times the `gradient` (Nocedal & Wright 2006, alg. 7.4).

    inverse: about the inverse of the second derivative, up to a factor; free: one for entries that may move, zero for
    others (None: all may). A direction that leads uphill gives way to that of the gradient.
    """
    only = (lambda x: x) if free is None else (lambda x: x * free)
    left, used = only(gradient), list[tuple[Tensor, Tensor, float, float]]()
    for s, change in reversed(pairs):
        y = only(change)  # products with it are those of entries that may move
        curved = product(s, y)
        if curved > BENT * float(s.norm() * y.norm()):
            share = product(s, left) / curved
            left = left.sub(y, alpha=share)
            used.append((s, y, curved, share))
    result = inverse(left)
    if used:
        _, y, curved, _ = used[0]
        result = result * (curved / product(y, inverse(y)))
    for s, y, curved, share in reversed(used):
        result.add_(s, alpha=share - product(y, result) / curved)
    result = only(result)
    return -result if product(result, gradient) > 0 else -only(inverse(only(gradient)))


def product(a: Tensor, b: Tensor) -> float:
    """The scalar product of two arrays, twice as fast as the sum of their product."""
    return float(torch.dot(a.flatten(), b.flatten()))


class QuasiNewton:
    """An `Optimiser` of one parameter by L-BFGS, which needs the whole objective in every step.

    A step evaluates the objective once: the leaf is the point to be tried, `best` the last one that was accepted. It is
    accepted where the objective falls enough (Nocedal & Wright 2006, eq. 3.6a), or else the step is shortened to the
    minimum of a parabola. The rate bounds the first step, in the units of the parameter, and ten times it any other.

    inverse: about the inverse of the second derivative, up to a factor; memory: pairs that are remembered; worth: the
    fit has settled when accepted steps gain less of the loss than this, averaged over ten.
    """

    def __init__(self, leaves: Leaves, inverse: Callable[[Tensor], Tensor], memory: int, worth: float) -> None:
        require(len(leaves) == 1, f"L-BFGS moves one parameter, but {', '.join(leaves)} are free.")
        (self._name,) = leaves
        self._leaves, self._inverse, self._memory, self._worth = leaves, inverse, memory, worth
        self._begin()

    def _begin(self) -> None:
        self._point: Tensor | None = None
        self._slope = self._way = torch.empty(0)
        self._pairs = list[tuple[Tensor, Tensor]]()
        self._values = list[float]()
        self._length, self._rate, self._stuck = 1.0, 0.0, False

    @property
    def settled(self) -> bool:
        """Whether steps are no longer worth it, or none lowers the objective."""
        values = self._values
        return self._stuck or (len(values) > WINDOW and values[-1 - WINDOW] - values[-1] < WINDOW * self._worth)

    def prepare(self, rates: Mapping[str, float]) -> None:
        """See `Optimiser`."""
        self._rate = rates[self._name]

    @torch.no_grad()
    def apply(self, loss: Tensor) -> None:
        """Judge the leaf by its loss, accept or shorten the step, and make the leaf the next point to be tried."""
        leaf, value = self._leaves[self._name], float(loss)
        assert leaf.grad is not None
        trial, slope = leaf.detach().clone(), leaf.grad.clone()
        leaf.grad = None
        if self._point is None:
            require(value < float("inf"), "the fit begins where its objective is no number; check the frames for NaN.")
            self._accept(trial, slope, value)
        else:
            promised = self._length * float((self._slope * self._way).sum())
            if value <= self._values[-1] + SUFFICIENT * promised:
                step, change = trial - self._point, slope - self._slope
                if product(step, change) > BENT * float(step.norm() * change.norm()):  # else no minimum lies ahead
                    self._pairs = [*self._pairs[len(self._pairs) + 1 - self._memory :], (step, change)]
                self._accept(trial, slope, value)
            else:
                self._shorten(value - self._values[-1], promised)
        assert self._point is not None
        leaf.copy_(self._point + self._length * self._way)

    def _accept(self, point: Tensor, slope: Tensor, value: float) -> None:
        self._point, self._slope = point, slope
        self._values = [*self._values[-WINDOW:], value]
        self._turn()

    def _turn(self) -> None:
        """The next direction, and how far to go along it."""
        self._way = direction(self._slope, self._pairs, self._inverse)
        longest = float(self._way.abs().max())
        bound = self._rate * (LONGER if self._pairs else 1.0)
        first = bound / longest if longest > 0 else 0.0
        self._length = min(1.0, first) if self._pairs else first
        self._stuck = longest == 0

    def _shorten(self, rise: float, promised: float) -> None:
        """Along the same direction; or along that of the gradient, where the direction leads nowhere."""
        best = promised / (2 * (promised - rise)) if rise < float("inf") else 0.0
        self._length *= min(max(best, LEAST_SHRINK), MOST_SHRINK)
        assert self._point is not None
        nowhere = bool(torch.equal(self._point + self._length * self._way, self._point))
        shortest = self._length * float(self._way.abs().max()) < 1e-9 * self._rate
        if nowhere or shortest:
            self._stuck = not self._pairs
            self._pairs = []
            if not self._stuck:
                self._turn()

    def best(self) -> Leaves | None:
        """The point that was accepted last; None before the first step."""
        return None if self._point is None else {self._name: self._point}

    def resize(self, names: list[str], keep: Tensor, added: Mapping[str, Tensor]) -> None:
        """Begin anew from the resized leaf."""
        self._begin()

    def state_dict(self) -> dict[str, Any]:
        """See `Optimiser`."""
        arrays = {"point": self._point, "slope": self._slope, "way": self._way}
        numbers = {"values": list(self._values), "length": self._length, "stuck": self._stuck}
        pairs = [[one.cpu().clone() for one in pair] for pair in self._pairs]
        return {name: None if a is None else a.cpu().clone() for name, a in arrays.items()} | numbers | {"pairs": pairs}

    def load(self, state: dict[str, Any]) -> None:
        """See `Optimiser`."""
        self._point, self._slope, self._way = state["point"], state["slope"], state["way"]
        self._pairs = [(step, change) for step, change in state["pairs"]]
        self._values, self._length, self._stuck = list(state["values"]), float(state["length"]), bool(state["stuck"])
