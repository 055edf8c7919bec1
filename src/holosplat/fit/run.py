"""The engine of a run: steps and fits that are timed, kept, and resumed after an interruption; Ctrl-C between them."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from numbers import Real
from pathlib import Path
from types import FrameType
from typing import Any, Protocol

import torch

from ..checks import as_written, require
from ..model import Model
from ..tables import shown

CHECKPOINT_SECONDS = 20.0
"""Time between two checkpoints of a fit, or of a stage of several steps [s]."""

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


class Journal(Protocol):
    """Keeps the last state of a run, as a run folder does: tensors, and plain values."""

    @property
    def checkpoint(self) -> Path:
        """The file, for messages."""
        ...

    def load_checkpoint(self) -> Mapping[str, Any] | None:
        """Load the last saved state; None at the beginning."""
        ...

    def save_checkpoint(self, state: dict[str, Any]) -> None:
        """Keep `state` in place of what was saved before."""
        ...


class Run:
    """The engine of a run: each step is done once, timed and kept, and each fit has checkpoints.

    A run that goes on repeats no step, so its calculation must take the same steps each time, as all that are seeded
    do; the result is the same bit for bit. Steps give tensors and plain values.

    journal: keeps the state; None: nothing is kept; done: the results of the steps of an earlier run
    saved: the state at which an earlier run ended; empty at the beginning
    state: gives what else a recipe needs to go on, for each checkpoint
    timing: seconds of each stage; that of one within another counts for the inner one alone
    """

    def __init__(self, journal: Journal | None = None, done: Sequence[Any] = ()) -> None:
        self._journal, self._taken = journal, 0
        self.state: Callable[[], dict[str, Any]] = dict
        self._fit: Running | None = None
        self._inside, self._kept = False, time.perf_counter()
        with self.as_written():
            self.saved = {} if journal is None else dict(journal.load_checkpoint() or {})
            self.timing = {str(name): float(seconds) for name, seconds in self.saved.get("timing", {}).items()}
            self.done = list(self.saved.get("stage_steps", done))
        self._begun: Mapping[str, Any] | None = self.saved.get("fit")

    def as_written(self) -> AbstractContextManager[None]:
        """In which what a checkpoint lacks is an `InputError`."""
        return as_written("" if self._journal is None else self._journal.checkpoint, "a checkpoint of this run")

    def part(self, name: str) -> Run:
        """One of several runs that share a checkpoint, by its name."""
        return Run(None if self._journal is None else _Part(self._journal, self.saved, name))

    def step(self, name: str, act: Callable[[], Any], *, chain: bool = False) -> Any:
        """The result of the next step of the stage `name`, by `act` if no run has done it.

        chain: whether only the latest result of the stage is needed: it is kept alone, and at once, and stands for
        those of the steps before it.
        """
        number, self._taken = self._taken, self._taken + 1
        if number == len(self.done):
            with self.timed(name):
                found = act()
            self.done = [*([None] * number if chain else self.done), found]
            if chain or self._is_due:
                self.keep()
        return self.done[-1 if chain else number]

    def end_stage(self) -> None:
        """Keep the state after a stage; its fit and the results of its steps are no longer needed."""
        self.done, self._taken, self._fit = [], 0, None
        self.keep()

    @contextmanager
    def timed(self, name: str) -> Iterator[None]:
        """Add the time of the block to the stage `name`; the steps that are done are kept where Ctrl-C ends it."""
        began, before = time.perf_counter(), sum(self.timing.values())
        with self._kept_if_interrupted():
            yield
        others = sum(self.timing.values()) - before
        self.timing[name] = self.timing.get(name, 0.0) + time.perf_counter() - began - others

    def fit(self, name: str, fit: Running, show: Callable[[Record], None] = lambda record: None) -> bool:
        """Run a fit to its end, from where an earlier run was cut off in it, with checkpoints; whether it has ended.

        show: called with each record. Ctrl-C is passed on after the state is kept.
        """
        self.take_up(fit)
        self._fit = fit

        def look(record: Record) -> None:
            show(record)
            if record["step"] == fit.step and self._is_due:  # on a GPU, records come late and in batches
                self.keep()

        try:
            with self._kept_if_interrupted():
                fit.run(look)
        finally:
            self.timing[name] = self.timing.get(name, 0.0) + fit.seconds
        return fit.finished

    def take_up(self, fit: Running) -> bool:
        """Bring the fit in which an earlier run was cut off to where it was; whether `fit` is that one."""
        if self._begun is None:
            return False
        with self.as_written():
            require_alike(self._begun, fit.state_dict())
            fit.load(dict(self._begun))
        self._begun = None
        return True

    def keep(self) -> None:
        """Write a checkpoint."""
        if self._journal is not None:
            fit = None if self._fit is None else self._fit.state_dict()
            own = {"fit": fit, "timing": dict(self.timing), "stage_steps": list(self.done)}
            self._journal.save_checkpoint(self.state() | own)
        self._kept = time.perf_counter()

    @property
    def _is_due(self) -> bool:
        return time.perf_counter() - self._kept > CHECKPOINT_SECONDS

    @contextmanager
    def _kept_if_interrupted(self) -> Iterator[None]:
        """Keep the state where Ctrl-C ends the block, once for blocks within each other."""
        outer, self._inside = self._inside, True
        try:
            yield
        except KeyboardInterrupt:
            if not outer:
                self.keep()
            raise
        finally:
            self._inside = outer


def require_alike(saved: Any, own: Any, name: str = "") -> None:
    """`InputError` where a saved state has a value of another kind than a fit's `own` at its beginning: a text for a
    number, or a number for a table. What one of them lacks is left to the fit, as are lists."""
    if saved is None or own is None:
        return
    kinds = (Mapping, torch.Tensor, str, Real)
    kind = next((kind for kind in kinds if isinstance(own, kind)), object)
    require(isinstance(saved, kind), f"{name or 'the state'} must be like {shown(own)}, but it is {shown(saved)}.")
    if isinstance(own, Mapping):
        for key in own.keys() & saved.keys():
            require_alike(saved[key], own[key], str(key))


class _Part:
    """The journal of one of several runs; states: of all of them, by name."""

    def __init__(self, journal: Journal, states: dict[str, Any], name: str) -> None:
        self._journal, self._states, self._name = journal, states, name
        self.checkpoint = journal.checkpoint

    def load_checkpoint(self) -> Mapping[str, Any] | None:
        return self._states.get(self._name)

    def save_checkpoint(self, state: dict[str, Any]) -> None:
        self._states[self._name] = state
        self._journal.save_checkpoint(self._states)
