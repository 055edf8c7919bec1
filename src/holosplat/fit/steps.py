"""A long calculation that can be cut off between its steps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any


class Steps:
    """What the steps of a calculation gave, in their order: those that an earlier run has done are not done again.

    The calculation must take the same steps each time, as all that are seeded do; each gives tensors and plain values.
    done: what an earlier run's steps gave; on_step: called after each new one.
    """

    def __init__(self, done: Sequence[Any] = (), on_step: Callable[[], None] = lambda: None) -> None:
        self.done, self._taken, self._on_step = list(done), 0, on_step

    def of(self, make: Callable[[], Any]) -> Any:
        """What the next step gives, by `make` if no run has done it."""
        new = self._taken == len(self.done)
        if new:
            self.done.append(make())
        self._taken += 1
        if new:
            self._on_step()
        return self.done[self._taken - 1]
