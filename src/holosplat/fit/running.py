"""The interface of a resumable fit: steps that stop, save and continue; Ctrl-C between them; memoised steps."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from types import FrameType
from typing import Any, Protocol

from ..model import Model

Record = dict[str, float]
"""One row of metrics.csv."""


class Running(Protocol):
    """A fit in progress. `run` advances it; `state_dict` and `load` make it resumable (on a CPU bit for bit)."""

    step: int
    seconds: float
    backend: str

    @property
    def finished(self) -> bool:
        """Whether it has ended."""
        ...

    @property
    def stopped_early(self) -> bool:
        """Whether that was before all steps were done."""
        ...

    @property
    def best_step(self) -> int:
        """The step of the best state by validation frames; 0 without any."""
        ...

    @property
    def share(self) -> float:
        """How much of the work is done."""
        ...

    @property
    def oversample(self) -> int:
        """Wave samples a pixel."""
        ...

    @property
    def aside(self) -> int:
        """How many of the training frames are set aside for validation."""
        ...

    def result(self) -> Model:
        """The best model so far."""
        ...

    def resolved(self) -> dict[str, Any]:
        """What frames, noise and knowledge have made of the options."""
        ...

    def columns(self) -> list[str]:
        """Names of everything that a record may hold, in the order of metrics.csv."""
        ...

    def run(self, on_record: Callable[[Record], None], until: int | None = None) -> None:
        """Advance to the end (or to step `until`); Ctrl-C is held back until a step is complete."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """Everything that `load` needs to go on as if nothing had happened."""
        ...

    def load(self, state: dict[str, Any]) -> None:
        """Go back to a saved state."""
        ...


@contextmanager
def interrupts_held() -> Iterator[Callable[[], None]]:
    """Hold Ctrl-C back; the function that is yielded raises the `KeyboardInterrupt` that came in the meantime.

    A second Ctrl-C is not held back. Outside the main thread, where signals cannot be caught, nothing changes.
    """
    if threading.current_thread() is not threading.main_thread():
        yield lambda: None
        return
    previous = signal.getsignal(signal.SIGINT)
    waiting = False

    def hold(number: int, frame: FrameType | None) -> None:
        nonlocal waiting
        if waiting:
            raise KeyboardInterrupt
        waiting = True

    def release() -> None:
        if waiting:
            raise KeyboardInterrupt

    signal.signal(signal.SIGINT, hold)
    try:
        yield release
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler if previous is None else previous)


class Steps:
    """The results of the steps of a calculation, in order; steps of an earlier run are not repeated.

    The calculation must take the same steps each time, as all that are seeded do; each gives tensors and plain values.
    done: what an earlier run's steps gave; on_step: called after each new one.
    """

    def __init__(self, done: Sequence[Any] = (), on_step: Callable[[], None] = lambda: None) -> None:
        self.done, self._taken, self._on_step = list(done), 0, on_step

    def of(self, make: Callable[[], Any]) -> Any:
        """The result of the next step, by `make` if no run has done it."""
        new = self._taken == len(self.done)
        if new:
            self.done.append(make())
        self._taken += 1
        if new:
            self._on_step()
        return self.done[self._taken - 1]
