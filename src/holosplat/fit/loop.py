"""The optimisation loop: holograms in, a fitted cloud out, in steps that can be stopped and resumed."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..backends import resolve
from ..checks import InputError, require
from ..geometry import Grid, Poses
from ..memory import memory_kept
from ..model.instrument import Instrument
from ..optics.sampling import resolving_oversample
from ..representations.gaussians import GaussianCloud
from ..scan import Scan
from . import objective as terms
from .capture import CapturedStep
from .density import DensityControl, GradientRecord, control_density
from .interrupt import interrupts_held
from .misfit import IMAGE_TERMS, OBJECT_TERMS, Draw, Misfit
from .objective import Objective
from .schedule import Schedule
from .trainable import Trainable

UNREAD_STEPS = 20
"""Steps on a GPU between looks at their values, each of which waits for it."""

Record = dict[str, float]
"""One row of metrics.csv."""


class DivergedError(InputError):
    """Loss or parameters are no longer finite numbers after `step`."""

    def __init__(self, step: int) -> None:
        super().__init__(
            f"the fit diverged at step {step}: its parameters are no longer finite; "
            "lower the rates of the schedule (rate_position, rate_scale, rate_rotation, rate_amplitude)."
        )
        self.step = step


@dataclass(frozen=True)
class FitOptions:
    """What is minimised, how, where Gaussians come and go, and which backend does it (see `backends`)."""

    objective: Objective = field(default_factory=Objective)
    schedule: Schedule = field(default_factory=Schedule)
    density: DensityControl = field(default_factory=DensityControl)
    backend: str = "auto"


class Fit:
    """A fit in progress. `run` advances it; `state_dict` and `load` make it resumable (on a CPU bit for bit)."""

    def __init__(self, scan: Scan, cloud: GaussianCloud, options: FitOptions, seed: int = 0) -> None:
        self.options, self.seed = options, seed
        self.backend = resolve(options.backend)
        schedule = options.schedule
        self.train, self.validation = split_validation(scan.train(), schedule.validation_views)
        oversample = schedule.oversample or resolving_oversample(self.train.exposures, 1.5, at_least=1)
        self.instrument = Instrument(self.train.exposures, oversample, backend=self.backend)
        looks = len(self.validation) > 0
        self._judge = Instrument(self.validation.exposures, oversample, backend=self.backend) if looks else None
        require(np.ptp(self.train.frames) > 0, "all training frames are constant, so there is nothing to fit.")
        self._grid = Grid.of_views(scan.views)
        block = self._grid.block((0, 0, 0), self._block_shape())
        depth = self._grid.shape[0]
        self._misfit = Misfit(self.train, self.instrument, options.objective, schedule.detach_worst, block, depth)
        self.trainable = Trainable(cloud.on(self.backend), self.backend)
        self.gradients = GradientRecord()
        self.step, self.seconds = 0, 0.0
        self._unread: list[tuple[Record, list[str], Tensor]] = []
        self._capture = CapturedStep(self._work) if self.instrument.device.type == "cuda" else None
        self._generator = torch.Generator().manual_seed(seed)
        self._order: list[int] = []
        self.best_score, self.best_step, self._best = float("inf"), 0, self.cloud.detached()
        self.stopped_early = False

    @property
    def cloud(self) -> GaussianCloud:
        """The cloud as it is now."""
        return self.trainable.cloud

    @property
    def finished(self) -> bool:
        """Whether the schedule is done, or the fit stopped early."""
        return self.stopped_early or self.step >= self.options.schedule.steps

    def result(self) -> GaussianCloud:
        """The best cloud by the validation views, or the last one where there are none; in main memory."""
        best = self._best if self._judge is not None and self.best_step > 0 else self.cloud.detached()
        return best.on("cpu" if self.backend == "cuda" else self.backend)

    def columns(self) -> list[str]:
        """Names of everything that a record may hold, in the order of metrics.csv."""
        w = self.options.objective
        weights = {name: getattr(w, name) for name in (*IMAGE_TERMS, *OBJECT_TERMS)}
        used = [name for name, weight in weights.items() if weight > 0]
        judged = ["val_l1", "val_ssim", "val_frcm"] if self._judge is not None else []
        return ["step", "seconds", "loss", *used, "count", *judged]

    def run(self, on_record: Callable[[Record], None], until: int | None = None) -> None:
        """Advance to the end (or to step `until`); `on_record` receives one record a step, on a GPU in batches."""
        end = self.options.schedule.steps if until is None else min(until, self.options.schedule.steps)
        try:
            with memory_kept(), interrupts_held() as release:
                while self.step < end and not self.stopped_early:
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
        rows = [values.tolist() for _, _, values in unread]  # waits for the device
        self.seconds += time.perf_counter() - started
        for (record, names, _), row in zip(unread, rows):
            self._check_sound(record, row)
            on_record({"seconds": self.seconds, **record, **dict(zip(names, row))})

    def _advance(self) -> None:
        schedule, density = self.options.schedule, self.options.density
        draw = self._draw()
        self.trainable.prepare(schedule.rates(self.step))
        values = self._work(draw) if self._capture is None else self._capture(draw)
        if density.due(self.step, schedule.steps):
            control_density(self.trainable, self.gradients, self.train.views, density, self._generator)
            if self._capture is not None:
                self._capture.forget()
        self.step += 1
        record: Record = {"step": self.step, "count": len(self.cloud)}
        self._unread.append((record, self._misfit.names(self.cloud, draw), values))
        if self._judge is not None and (self.step % schedule.validate_every == 0 or self.step == schedule.steps):
            record |= self._validate()

    def _work(self, draw: Draw) -> Tensor:
        """One step on the device: gradients, what density control wants of them, Adam. Waits for nothing."""
        loss, values = self._misfit(self.cloud, draw)
        loss.backward()
        if self.options.density.every > 0:
            self.gradients.add(_gradient(self.cloud.centres))
        self.trainable.apply()
        sound = torch.stack([p.detach().sum() for p in self.cloud.parameters]).sum()[None]
        return torch.cat([values, sound])

    def _check_sound(self, record: Record, row: list[float]) -> None:
        """`DivergedError` if loss (first) or parameters (their sum, last) are no longer numbers."""
        if not math.isfinite(row[0] + row[-1]):
            raise DivergedError(int(record["step"]))

    def _draw(self) -> Draw:
        """What the next step looks at, by the schedule and the generator."""
        schedule, w, on = self.options.schedule, self.options.objective, self.instrument.device
        views = self._draw_views()
        whole = len(views) == len(self.train)
        volume = schedule.volume_every if w.uses_volume and self.step % schedule.volume_every == 0 else 0
        middle = self._volume_block().centre if volume else np.zeros(3)
        return Draw(
            None if whole else torch.from_numpy(views).to(on, non_blocking=True),
            torch.from_numpy(middle).to(on, non_blocking=True),
            torch.tensor(self.step / schedule.steps).to(on, non_blocking=True),
            volume,
        )

    def _draw_views(self) -> np.ndarray:
        """The views of this step: all, or the next ones of a shuffled order without replacement."""
        count = self.options.schedule.views_per_step
        if count <= 0 or count >= len(self.train):
            return np.arange(len(self.train))
        if len(self._order) < count:  # those left over from the last round come first, and not again in this step
            fresh: list[int] = torch.randperm(len(self.train), generator=self._generator).tolist()
            left = set(self._order)
            self._order += [v for v in fresh if v not in left] + [v for v in fresh if v in left]
        drawn, self._order = self._order[:count], self._order[count:]
        return np.array(sorted(drawn))

    def _volume_block(self) -> Grid:
        """Where this step looks at the volume: all of it, or a random block where it is large."""
        shape = self._block_shape()
        free = [n - m for n, m in zip(self._grid.shape, shape)]
        start = [int(torch.randint(f + 1, (1,), generator=self._generator)) for f in free]
        return self._grid.block((start[0], start[1], start[2]), shape)

    def _block_shape(self) -> tuple[int, int, int]:
        z, y, x = (min(n, self.options.schedule.volume_edge) for n in self._grid.shape)
        return z, y, x

    def _validate(self) -> Record:
        """Look at the validation views; keeps the best cloud, and stops the fit when patience is over."""
        assert self._judge is not None
        with torch.no_grad():
            lines = self.cloud.project(Poses.of(self._judge.views, self._judge.device))
            predicted = self._judge.frames(lines).cpu()
        frames, low, span = torch.from_numpy(self.validation.frames), self._misfit.low, self._misfit.span
        a, b = (predicted - low) / span, (frames - low) / span
        ssim, frcm = (1 - float(term(a, b).mean()) for term in (terms.one_minus_ssim, terms.one_minus_frcm))
        score = 1 - 0.5 * (ssim + frcm)  # not L1, which prefers a blurred object to one with its fringes misplaced
        if score < self.best_score:
            self.best_score, self.best_step, self._best = score, self.step, self.cloud.detached()
        schedule = self.options.schedule
        overdue = self.step - self.best_step >= schedule.patience * schedule.validate_every
        self.stopped_early = schedule.patience > 0 and overdue
        return {"val_l1": float(terms.l1(a, b).mean()), "val_ssim": ssim, "val_frcm": frcm}

    def state_dict(self) -> dict[str, Any]:
        """Everything that `load` needs to go on as if nothing had happened."""
        return {
            "trainable": self.trainable.state_dict(),
            "gradients": None if self.gradients.total is None else self.gradients.total.cpu().clone(),
            "step": self.step,
            "seconds": self.seconds,
            "generator": self._generator.get_state(),
            "order": self._order,
            "best": (self.best_score, self.best_step, [p.cpu().clone() for p in self._best.parameters]),
            "stopped_early": self.stopped_early,
        }

    def load(self, state: dict[str, Any]) -> None:
        """Go back to a saved state."""
        self.trainable.load(state["trainable"])
        total = state["gradients"]
        self.gradients.total = None if total is None else total.to(self.instrument.device).clone()
        self.step, self.seconds, self.stopped_early = state["step"], state["seconds"], state["stopped_early"]
        self._generator.set_state(state["generator"])
        self._order = list(state["order"])
        self.best_score, self.best_step, parameters = state["best"]
        self._best = self._best.replaced(p.to(self.instrument.device) for p in parameters)
        if self._capture is not None:
            self._capture.forget()


def split_validation(train: Scan, count: int) -> tuple[Scan, Scan]:
    """Training frames without, and only, `count` evenly spread validation frames; `InputError` if none is left."""
    require(
        count < len(train),
        f"validation_views must leave a training frame: {count} of {len(train)} are asked for.",
    )
    chosen = np.zeros(len(train), dtype=bool)
    if count > 0:
        chosen[((np.arange(count) + 0.5) * len(train) / count).astype(int)] = True
    return train[np.flatnonzero(~chosen)], train[np.flatnonzero(chosen)]


def _gradient(parameter: Tensor) -> Tensor:
    return torch.zeros_like(parameter) if parameter.grad is None else parameter.grad
