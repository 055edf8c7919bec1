"""Steps in time whose length follows from an estimate of their error."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from ...checks import InputError, require

SAFETY, SHRINK, GROW = 0.9, 0.2, 3.0
SMALLEST = 1e-6
"""A step shorter than this fraction of the time to cover is taken for a failure."""

Check = Callable[[Tensor, float], None]


@dataclass(frozen=True)
class State:
    """Nodes [C, P, 3] [m] at `time` [s], the next step to try [s], and how many steps were taken and refused."""

    nodes: Tensor
    time: float
    step: float
    taken: int = 0
    refused: int = 0


class Stepper:
    """The method of Bogacki & Shampine (1989, Appl. Math. Lett. 2, 321), third order, with steps of chosen length.

    Each step is also made to second order; the greatest distance between both results over all nodes is the estimate of
    its error. A step is kept where that is below the tolerance, and the next one is as long as the tolerance allows
    (with a margin). Steps that are too long for the stiffness of the membranes amplify the error, and so are refused
    by the same rule: it also keeps the method stable.
    """

    def __init__(self, velocity: Callable[[Tensor], Tensor], tolerance: float) -> None:
        self.velocity, self.tolerance = velocity, tolerance

    def advance(self, state: State, until: float, check: Check = lambda nodes, time: None) -> State:
        """`state` at the time `until` [s]; `check` is called with nodes and time after every step.

        `InputError` where steps vanish.
        """
        require(until >= state.time, f"the time to reach must lie ahead, but {until} s is before {state.time} s.")
        nodes, time, step, taken, refused = state.nodes, state.time, state.step, state.taken, state.refused
        shortest = SMALLEST * (until - time)
        slope = self.velocity(nodes) if until > time else nodes
        while time < until:
            last = time + 1.0000001 * step >= until  # no crumb is left over
            trial = until - time if last else step
            moved, next_slope, error = self._step(nodes, slope, trial)
            factor = SAFETY * (self.tolerance / max(error, 1e-3 * self.tolerance)) ** (1 / 3)
            if error <= self.tolerance:
                nodes, slope, time, taken = moved, next_slope, until if last else time + trial, taken + 1
                step = max(step, trial * min(GROW, factor)) if last else trial * min(GROW, factor)
            else:  # NaN too
                step = trial * (max(SHRINK, factor) if error < float("inf") else SHRINK)
                refused += 1
                if not step > shortest:
                    raise InputError(
                        f"the motion must be smooth, but at {time:.6g} s steps became shorter than {step:.3g} s: the "
                        "membranes or contacts are too stiff, or the flow too fast; lower one of them."
                    )
            check(nodes, time)
        return State(nodes, time, step, taken, refused)

    def _step(self, nodes: Tensor, slope: Tensor, step: float) -> tuple[Tensor, Tensor, float]:
        """Nodes after `step`, the velocity there, and the estimated error [m]."""
        second = self.velocity(nodes + 0.5 * step * slope)
        third = self.velocity(nodes + 0.75 * step * second)
        moved = nodes + step * (2 / 9 * slope + 1 / 3 * second + 4 / 9 * third)
        last = self.velocity(moved)
        error = step * (-5 / 72 * slope + 1 / 12 * second + 1 / 9 * third - 1 / 8 * last)
        worst = float(error.norm(dim=-1).max())
        return moved, last, worst if torch.isfinite(error).all() else float("inf")
