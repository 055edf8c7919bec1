"""The one optimisation loop: a problem in, a fitted model out, in steps that can be stopped and resumed.

It knows frames, parameters by name and optimisers, and no representation: what a method does beside the steps (density
control, pruning) comes as events.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import torch
from torch import Tensor

from ..checks import InputError
from ..geometry import Grid
from ..memory import memory_kept
from ..model import Model
from .optimiser import Leaves, Optimiser, Trainable
from .problem import Batch, Batches, CapturedStep, Problem, Schedule
from .residuals import Judge
from .run import Record, interrupts_held

UNREAD_STEPS = 20
"""Steps on a GPU between looks at their values, each of which waits for it."""


class DivergedError(InputError):
    """Loss or parameters are no longer finite numbers after `step`."""

    def __init__(self, step: int) -> None:
        super().__init__(
            f"the fit diverged at step {step}: its parameters are no longer finite; lower the rates of the method."
        )
        self.step = step


class Event(Protocol):
    """What a method does beside the steps."""

    def on_gradients(self, leaves: Leaves) -> None:
        """After the backward pass of every step, on the device alone."""
        ...

    def after_step(self, trainable: Trainable, step: int, steps: int, generator: torch.Generator) -> bool:
        """After each step (counted from 0); whether tensors moved, so that a captured step must be captured anew."""
        ...

    def columns(self, model: Model) -> Record:
        """What joins the record of a step."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """The state, in main memory."""
        ...

    def load(self, state: dict[str, Any]) -> None:
        """Go back to a saved state."""
        ...


class Stateless:
    """Of an `Event`, what one that follows from the step alone need not say: it looks at no gradients, adds nothing to
    the record, and has no state."""

    def on_gradients(self, leaves: Leaves) -> None:
        """Leaves gradients as they are."""

    def columns(self, model: Model) -> Record:
        """No columns."""
        return {}

    def state_dict(self) -> dict[str, Any]:
        """An empty state."""
        return {}

    def load(self, state: dict[str, Any]) -> None:
        """There is no state to load."""


def _no_rates(factor: float, step: int) -> Mapping[str, float]:
    return {}


@dataclass(frozen=True)
class Plan:
    """Everything that a fit needs.

    problem: what is minimised
    schedule: how long, and by how many frames a step
    optimiser: makes the optimiser of the free parameters
    rates: (share of the rates that is left, step) → the rate of each parameter
    events: what the method does beside the steps
    judge: scores the validation frames; None without any
    grid: the volume that terms look at in blocks; None without such terms
    generator: draws everything random; None for one made of the seed
    capture: whether steps on a GPU may become CUDA graphs: their launches must not depend on values
    """

    problem: Problem
    schedule: Schedule
    optimiser: Callable[[Leaves], Optimiser]
    rates: Callable[[float, int], Mapping[str, float]] = _no_rates
    events: Sequence[Event] = ()
    judge: Judge | None = None
    grid: Grid | None = None
    generator: torch.Generator | None = None
    capture: bool = True


@dataclass
class _Best:
    """The best state by the validation frames."""

    leaves: Leaves
    score: float = float("inf")
    step: int = 0


@dataclass
class _Unread:
    """Values of a step that were not read from the device yet."""

    record: Record
    names: list[str]
    values: Tensor = field(repr=False)


class Fit:
    """A fit in progress. `run` advances it; `state_dict` and `load` make it resumable (on a CPU bit for bit)."""

    def __init__(self, plan: Plan, seed: int = 0) -> None:
        self.plan, self.schedule, self.seed = plan, plan.schedule, seed
        instrument = plan.problem.model.instrument
        self.backend, self._device = instrument.backend, instrument.device
        self.trainable = Trainable(plan.problem, plan.optimiser)
        generator = plan.generator or torch.Generator().manual_seed(seed)
        self._batches = Batches(len(instrument.views), plan.schedule, self._device, generator, plan.grid)
        self.step, self.seconds, self.stopped_early = 0, 0.0, False
        self._names: dict[int, list[str]] = {}
        self._unread: list[_Unread] = []
        captured = plan.capture and plan.problem.model.capturable and self._device.type == "cuda"
        self._capture = CapturedStep(self._work) if captured else None
        self._best = _Best(self.trainable.snapshot())

    @property
    def model(self) -> Model:
        """The model as it is now."""
        return self.trainable.model

    @property
    def best_step(self) -> int:
        """The step of the best state by the validation frames; 0 without any."""
        return self._best.step

    @property
    def finished(self) -> bool:
        """Whether the schedule is done, or the fit stopped early."""
        return self.stopped_early or self.schedule.share(self.step, self.seconds) >= 1

    @property
    def share(self) -> float:
        """How much of the schedule is done."""
        return min(1.0, self.schedule.share(self.step, self.seconds))

    @property
    def oversample(self) -> int:
        """Wave samples a pixel."""
        return self.plan.problem.model.instrument.oversample

    @property
    def aside(self) -> int:
        """How many of the training frames are set aside for validation."""
        return len(self.plan.judge.scan) if self.plan.judge else 0

    def resolved(self) -> dict[str, Any]:
        """What the frames' noise and the views have made of the options."""
        return self.plan.problem.resolved()

    def result(self) -> Model:
        """The best model by the validation frames or the optimiser, or else the last one; it carries no gradients."""
        judged = self.plan.judge is not None and self._best.step > 0
        found = self._best.leaves if judged else self.trainable.optimiser.best()
        return self.plan.problem.model.with_parameters(self.trainable.snapshot() if found is None else found)

    def left(self) -> float:
        """The loss of all frames, and of terms on the object, that the result has."""
        there = self._device
        whole = Batch(None, torch.zeros(3, dtype=torch.float64, device=there), torch.tensor(1.0, device=there), 0)
        with torch.no_grad():
            return float(self.plan.problem.loss(self.result(), whole)[0])

    def columns(self) -> list[str]:
        """Names of everything that a record may hold, in the order of metrics.csv."""
        names = [name for term in self.plan.problem.terms for name in term.names]
        own = [name for event in self.plan.events for name in event.columns(self.model)]
        return ["step", "seconds", "loss", *names, *own, *(Judge.COLUMNS if self.plan.judge else ())]

    def run(self, on_record: Callable[[Record], None], until: int | None = None) -> None:
        """Advance to the end (or to step `until`); `on_record` receives one record a step, on a GPU in batches.

        Ctrl-C is held back until a step is complete, then `KeyboardInterrupt` is raised from here.
        """
        with memory_kept(), interrupts_held() as release:
            try:
                while not self.finished and (until is None or self.step < until):
                    started = time.perf_counter()
                    self._advance()
                    if self._capture is None or len(self._unread) >= UNREAD_STEPS:
                        self._deliver(on_record, started)
                    else:
                        self.seconds += time.perf_counter() - started
                    release()
            finally:
                self._deliver(on_record, time.perf_counter())

    def _deliver(self, on_record: Callable[[Record], None], started: float) -> None:
        """Read the steps that were not read yet, count the time since `started`, and hand out their records."""
        unread, self._unread = self._unread, []
        rows = [one.values.tolist() for one in unread]  # waits for the device
        self.seconds += time.perf_counter() - started
        for one, row in zip(unread, rows):
            if not math.isfinite(row[0] + row[-1]):
                raise DivergedError(int(one.record["step"]))
            on_record({"seconds": self.seconds, **one.record, **dict(zip(one.names, row))})

    def _advance(self) -> None:
        schedule = self.schedule
        share = min(1.0, schedule.share(self.step, self.seconds))
        batch = self._batches.draw(self.step, share)
        self.trainable.optimiser.prepare(self.plan.rates(schedule.factor(self.step, self.seconds), self.step))
        values = self._work(batch) if self._capture is None else self._capture(batch)
        for event in self.plan.events:
            moved = event.after_step(self.trainable, self.step, schedule.steps, self._batches.generator)
            if moved and self._capture is not None:
                self._capture.forget()
        self.step += 1
        self.stopped_early = self.trainable.optimiser.settled
        record: Record = {"step": self.step}
        for event in self.plan.events:
            record |= event.columns(self.model)
        if self.plan.judge and (self.step % schedule.validate_every == 0 or self.step == schedule.steps):
            record |= self._validate(self.plan.judge)
        self._unread.append(_Unread(record, self._names[batch.volume], values))

    def _work(self, batch: Batch) -> Tensor:
        """One step on the device: gradients, what events want of them, the optimiser. Waits for nothing."""
        values = self._gradients(batch)
        for event in self.plan.events:
            event.on_gradients(self.trainable.leaves)
        self.trainable.optimiser.apply(values[0])
        sums = [leaf.detach().sum() for leaf in self.trainable.leaves.values()]
        sound = torch.stack([s.to(values.dtype) for s in sums]).sum()[None]
        return torch.cat([values, sound])

    def _gradients(self, batch: Batch) -> Tensor:
        """Of the loss, and the values [1 + K] of it and its parts: means over parts of the batch by their frames."""
        sums = list[Tensor]()
        for part, share in self._batches.parts(batch):
            loss, values, self._names[batch.volume] = self.plan.problem.loss(self.model, part)
            (loss if share == 1 else share * loss).backward()
            sums.append(values if share == 1 else share * values)
        return sum(sums[1:], start=sums[0])

    def _validate(self, judge: Judge) -> Record:
        """Look at the validation frames; keeps the best state, and stops the fit when patience is over."""
        score, columns = judge(self.model)
        if score < self._best.score:
            self._best = _Best(self.trainable.snapshot(), score, self.step)
        overdue = self.step - self._best.step >= self.schedule.patience * self.schedule.validate_every
        self.stopped_early |= self.schedule.patience > 0 and overdue
        return columns

    def state_dict(self) -> dict[str, Any]:
        """Everything that `load` needs to go on as if nothing had happened."""
        best = self._best
        return {
            "trainable": self.trainable.state_dict(),
            "events": [event.state_dict() for event in self.plan.events],
            "step": self.step,
            "seconds": self.seconds,
            "generator": self._batches.generator.get_state(),
            "order": list(self._batches.order),
            "best": (best.score, best.step, {name: leaf.cpu().clone() for name, leaf in best.leaves.items()}),
            "stopped_early": self.stopped_early,
        }

    def load(self, state: dict[str, Any]) -> None:
        """Go back to a saved state."""
        self.trainable.load(state["trainable"])
        for event, saved in zip(self.plan.events, state["events"]):
            event.load(saved)
        self.step, self.seconds, self.stopped_early = state["step"], state["seconds"], state["stopped_early"]
        self._batches.generator.set_state(state["generator"])
        self._batches.order = list(state["order"])
        score, step, leaves = state["best"]
        self._best = _Best({name: leaf.to(self._device) for name, leaf in leaves.items()}, score, step)
        if self._capture is not None:
            self._capture.forget()
