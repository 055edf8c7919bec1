"""The optimisation loop: holograms in, a fitted cloud out, in steps that can be stopped and resumed."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..checks import require
from ..forward import Instrument, resolving_oversample
from ..geometry import Grid
from ..representations.gaussians import GaussianCloud
from ..scan import Scan
from . import objective as terms
from .density import DensityControl, GradientRecord, control_density
from .interrupt import interrupts_held
from .objective import Objective
from .schedule import Schedule
from .trainable import Trainable

IMAGE_TERMS = ("l1", "l2_amplitude", "ssim", "tv_image", "frc")
OBJECT_TERMS = ("anisotropy", "tv_volume", "overfull")

Record = dict[str, float]
"""One row of metrics.csv."""


@dataclass(frozen=True)
class FitOptions:
    """What is minimised, how, and where Gaussians come and go."""

    objective: Objective = field(default_factory=Objective)
    schedule: Schedule = field(default_factory=Schedule)
    density: DensityControl = field(default_factory=DensityControl)


class Fit:
    """A fit in progress. `run` advances it; `state_dict` and `load` make it resumable, bit for bit."""

    def __init__(self, scan: Scan, cloud: GaussianCloud, options: FitOptions, seed: int = 0) -> None:
        self.options, self.seed = options, seed
        self.train, self.validation = split_validation(scan.train(), options.schedule.validation_views)
        oversample = options.schedule.oversample or resolving_oversample(self.train.exposures, 1.5, at_least=1)
        self.instrument = Instrument(self.train.exposures, oversample)
        self._judge = Instrument(self.validation.exposures, oversample) if len(self.validation) else None
        self._low, self._high = float(self.train.frames.min()), float(self.train.frames.max())
        require(self._high > self._low, "all training frames are constant, so there is nothing to fit.")
        self._measured = torch.from_numpy(self.train.frames)
        self._grid = Grid.of_views(scan.views)
        self.trainable = Trainable(cloud)
        self.gradients = GradientRecord()
        self.step, self.seconds = 0, 0.0
        self._generator = torch.Generator().manual_seed(seed)
        self._order: list[int] = []
        self.best_score, self.best_step, self._best = float("inf"), 0, cloud.detached()
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
        """The best cloud by the validation views, or the last one where there are none."""
        return self._best if self._judge is not None and self.best_step > 0 else self.cloud.detached()

    def columns(self) -> list[str]:
        """Names of everything that a record may hold, in the order of metrics.csv."""
        w = self.options.objective
        weights = {name: getattr(w, name) for name in (*IMAGE_TERMS, *OBJECT_TERMS)}
        used = [name for name, weight in weights.items() if weight > 0]
        judged = ["val_l1", "val_ssim", "val_frcm"] if self._judge is not None else []
        return ["step", "seconds", "loss", *used, "count", *judged]

    def run(self, on_record: Callable[[Record], None], until: int | None = None) -> None:
        """Advance to the end (or to step `until`); `on_record` receives one record a step."""
        end = self.options.schedule.steps if until is None else min(until, self.options.schedule.steps)
        with interrupts_held() as release:
            while self.step < end and not self.stopped_early:
                started = time.perf_counter()
                record = self._advance()
                self.seconds += time.perf_counter() - started
                on_record({"step": self.step, "seconds": self.seconds, **record})
                release()

    def _advance(self) -> Record:
        schedule = self.options.schedule
        record = self._gradients(self._draw_views())
        self.gradients.add(_gradient(self.cloud.centres))
        self.trainable.step(schedule.rates(self.step))
        if self.options.density.due(self.step, schedule.steps):
            control_density(self.trainable, self.gradients, self.train.views, self.options.density, self._generator)
        self.step += 1
        record["count"] = len(self.cloud)
        if self._judge is not None and (self.step % schedule.validate_every == 0 or self.step == schedule.steps):
            record |= self._validate()
        return record

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

    def _gradients(self, index: np.ndarray) -> Record:
        """Back-propagate the objective of the views `index`; returns its terms."""
        schedule = self.options.schedule
        predicted = self.instrument.measure(self.cloud, index)
        parts = self._image_terms(predicted, self._measured[torch.from_numpy(index)])
        per_view = sum(weight * value for weight, value in parts.values())
        assert isinstance(per_view, Tensor)
        if schedule.detach_worst and len(index) > 1:
            per_view = torch.where(per_view > per_view.detach().median(), per_view.detach(), per_view)
        loss = per_view.mean()
        record = {name: float(value.detach().mean()) for name, (_, value) in parts.items()}
        for name, weight, value in self._object_terms():
            loss = loss + weight * value
            record[name] = float(value.detach())
        loss.backward()
        return {"loss": float(loss.detach()), **record}

    def _image_terms(self, predicted: Tensor, measured: Tensor) -> dict[str, tuple[float, Tensor]]:
        """Weight and value [V] of every image term in use."""
        w = self.options.objective
        span = self._high - self._low
        a, b = (predicted - self._low) / span, (measured - self._low) / span
        ramp = min(1.0, self.step / max(1.0, w.frc_ramp * self.options.schedule.steps))
        table: list[tuple[str, float, Callable[[], Tensor]]] = [
            ("l1", w.l1, lambda: terms.l1(a, b)),
            ("l2_amplitude", w.l2_amplitude, lambda: terms.l2_amplitude(predicted, measured)),
            ("ssim", w.ssim, lambda: terms.one_minus_ssim(a, b)),
            ("tv_image", w.tv_image, lambda: terms.tv_image(a)),
            ("frc", w.frc * ramp, lambda: terms.one_minus_frcm(a, b)),
        ]
        return {name: (weight, value()) for name, weight, value in table if weight > 0}

    def _object_terms(self) -> list[tuple[str, float, Tensor]]:
        """Name, weight and value of every term on the Gaussians in use at this step."""
        w, every = self.options.objective, self.options.schedule.volume_every
        found = []
        if w.anisotropy > 0:
            found.append(("anisotropy", w.anisotropy, terms.anisotropy(self.cloud.log_scales, w.anisotropy_limit)))
        if w.uses_volume and self.step % every == 0:
            density = self.cloud.density(self._volume_block())
            if w.tv_volume > 0:
                found.append(("tv_volume", w.tv_volume * every, terms.tv_volume(density)))
            if w.overfull > 0 and self.cloud.single_material:
                found.append(("overfull", w.overfull * every, terms.overfull(density)))
        return found

    def _volume_block(self) -> Grid:
        """Where this step looks at the volume: all of it, or a random block where it is large."""
        edge = self.options.schedule.volume_edge
        shape = tuple(min(n, edge) for n in self._grid.shape)
        free = [n - m for n, m in zip(self._grid.shape, shape)]
        start = [int(torch.randint(f + 1, (1,), generator=self._generator)) for f in free]
        return self._grid.block((start[0], start[1], start[2]), (shape[0], shape[1], shape[2]))

    def _validate(self) -> Record:
        """Look at the validation views; keeps the best cloud, and stops the fit when patience is over."""
        assert self._judge is not None
        with torch.no_grad():
            predicted = self._judge.measure(self.cloud)
        span = self._high - self._low
        a, b = (predicted - self._low) / span, (torch.from_numpy(self.validation.frames) - self._low) / span
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
            "gradients": self.gradients.total,
            "step": self.step,
            "seconds": self.seconds,
            "generator": self._generator.get_state(),
            "order": self._order,
            "best": (self.best_score, self.best_step, [p.clone() for p in self._best.parameters]),
            "stopped_early": self.stopped_early,
        }

    def load(self, state: dict[str, Any]) -> None:
        """Go back to a saved state."""
        self.trainable.load(state["trainable"])
        self.gradients.total = state["gradients"]
        self.step, self.seconds, self.stopped_early = state["step"], state["seconds"], state["stopped_early"]
        self._generator.set_state(state["generator"])
        self._order = list(state["order"])
        self.best_score, self.best_step, parameters = state["best"]
        self._best = self._best.replaced(parameters)


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
