"""Terms and fits of matter at several times: frames of a few times a step, and total variation in space and time."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from holosplat.checks import require
from holosplat.fit.loop import Fit, Plan
from holosplat.fit.optimiser import Adam
from holosplat.fit.problem import Batch, LossPart, Problem, Schedule
from holosplat.fit.terms import Objective
from holosplat.fit.terms.frames import FrameTerm
from holosplat.fit.total_variation import total_variation
from holosplat.methods.ground import Ground, ground
from holosplat.methods.method import Task
from holosplat.model import Model
from holosplat.ranges import Natural, Positive, Share, SomeShare, Weight, checked_dataclass
from holosplat.representations import Stored, VoxelGrid
from holosplat.scan import Scan
from holosplat.volume import Object

from .moving_voxels import VoxelSeries

VOLUMES = "object.volumes"
"""The parameter of a `VoxelSeries`."""


@checked_dataclass
class DrawnTimes:
    """Which times a step looks at."""

    count: Natural = 1
    """Times of a step, with all their frames: memory is that of so many."""
    opening: Share = 0.0
    """Share of the steps in which the times that are drawn from grow from those in the middle to all (0: all from the
    first step on)."""

    def among(self, times: int, progress: float) -> tuple[int, int]:
        """First time that is drawn from, and the one after the last, of so many at a `progress` from 0 to 1."""
        part = min(1.0, progress / self.opening) if self.opening > 0 else 1.0
        wide = min(times, max(self.count, 3, round(part * times)))
        first = (times - wide) // 2
        return first, first + wide


class Cost(Protocol):
    """What matter in motion costs beside its frames."""

    name: str
    weight: float

    def __call__(self, moving: Any, seen: Sequence[tuple[float, VoxelGrid]]) -> Tensor:
        """The cost [] of `moving` at the times [s] that a step looks at, with its voxels then; a mean over these."""
        ...


class Variation:
    """∫ |∇u| [voxel edges²] of the occupancy at a time, smoothed below `smoothing`."""

    name = "variation"

    def __init__(self, weight: float, smoothing: float) -> None:
        self.weight, self._smoothing = weight, smoothing

    def __call__(self, moving: Any, seen: Sequence[tuple[float, VoxelGrid]]) -> Tensor:
        """The mean over the times."""
        totals = [total_variation(one.values, self._smoothing, "cpu") * one.values.numel() for _, one in seen]
        return torch.stack(totals).mean()


class SomeTimes:
    """The misfit of all frames of some times, drawn anew in each step, and what their matter costs.

    The matter of a time is made once a step, for frames and costs.
    """

    def __init__(
        self,
        frames: FrameTerm,
        train: Scan,
        drawn: DrawnTimes,
        costs: Sequence[Cost],
        generator: torch.Generator,
    ) -> None:
        """frames: the data term of the training frames `train`; generator: draws the times, and is the fit's."""
        self._frames, self._drawn, self._costs, self._generator = frames, drawn, tuple(costs), generator
        self._times = train.instants
        self._places = [np.flatnonzero(train.exposures.time == time) for time in self._times]
        self.names = (*frames.names, *(cost.name for cost in costs))
        self.resolved = {**frames.resolved, **{cost.name: cost.weight for cost in costs}}

    def __call__(self, model: Model, batch: Batch) -> Sequence[LossPart]:
        """The parts of the loss."""
        first, end = self._drawn.among(len(self._times), float(batch.progress))
        order = torch.randperm(end - first, generator=self._generator)[: self._drawn.count]
        chosen = sorted(first + int(k) for k in order)
        seen = {float(self._times[k]): _voxels(model.object.at(float(self._times[k]))) for k in chosen}
        index = torch.from_numpy(np.concatenate([self._places[k] for k in chosen]))
        part = replace(batch, index=index)
        found = list(self._frames(replace(model, object=_Seen(model.object, seen)), part))
        values = [cost(model.object, list(seen.items())) for cost in self._costs]
        return [*found, *(LossPart(cost.name, cost.weight, value) for cost, value in zip(self._costs, values))]


@dataclass(frozen=True)
class _Seen:
    """A moving object whose matter of some times is made already."""

    moving: Object
    made: dict[float, VoxelGrid]

    def at(self, time: float) -> Object:
        return self.made[time] if time in self.made else self.moving.at(time)

    def project(self, views: Any) -> Any:
        return self.moving.project(views)

    def voxelise(self, grid: Any) -> Any:
        return self.moving.voxelise(grid)


def _voxels(found: Object) -> VoxelGrid:
    assert isinstance(found, VoxelGrid)
    return found


class AllTimes:
    """The misfit of all frames of a `VoxelSeries`, a time after another, so that memory is that of one beside the
    volumes and their gradient."""

    def __init__(self, frames: FrameTerm, train: Scan) -> None:
        self._frames, self._train = frames, train
        self._places = [torch.from_numpy(np.flatnonzero(train.exposures.time == time)) for time in train.instants]
        self.names, self.resolved = ("frames",), dict(frames.resolved)

    def __call__(self, model: Model, batch: Batch) -> Sequence[LossPart]:
        """The one part: the mean over all frames."""
        series = model.object
        assert isinstance(series, VoxelSeries)
        still = series.at(float(series.times[0]))

        def of_one(k: int, volume: Tensor) -> Tensor:
            now, index = replace(model, object=still.with_parameters({"values": volume[None]})), self._places[k]
            misfit = self._frames(now, replace(batch, index=index))[0].value
            return misfit * (len(index) / len(self._train))

        return [LossPart("frames", 1.0, one_after_another(model.parameters()[VOLUMES], of_one))]


class SpaceTimeVariation4D:
    """∫ √(|∇u|² + κ² (∂u/∂t)²) of the volumes of a `VoxelSeries`, mean over times [voxel edges²], by differences
    between voxels and between times (κ: `pace`), smoothed below `smoothing`."""

    names = ("variation",)

    def __init__(self, weight: float, pace: float, smoothing: float) -> None:
        self._weight, self._pace, self._smoothing = weight, pace, smoothing
        self.resolved = {"variation": weight}

    def __call__(self, model: Model, batch: Batch) -> Sequence[LossPart]:
        """The one part."""
        volumes = model.parameters()[VOLUMES]
        total = space_time_variation(volumes, self._pace, self._smoothing)
        return [LossPart("variation", self._weight, total / len(volumes))]


def one_after_another(volumes: Tensor, function: Callable[[int, Tensor], Tensor]) -> Tensor:
    """Σ `function(k, volumes[k])` [] over the first axis, differentiable once; the graph of one k at a time is held."""
    found = _OneAfterAnother.apply(volumes, function)
    assert isinstance(found, Tensor)
    return found


class _OneAfterAnother(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, volumes: Tensor, function: Callable[[int, Tensor], Tensor]) -> Tensor:  # type: ignore[override]
        slopes, total = torch.empty_like(volumes), 0.0
        for k, volume in enumerate(volumes):
            with torch.enable_grad():
                leaf = volume.detach().requires_grad_()
                value = function(k, leaf)
                (slopes[k],) = torch.autograd.grad(value, leaf)
            total += float(value)
        ctx.slopes = slopes
        return volumes.new_tensor(total)

    @staticmethod
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor, None]:  # type: ignore[override]
        return upstream * ctx.slopes, None


def space_time_variation(volumes: Tensor, pace: float, smoothing: float) -> Tensor:
    """Σ √(|∇u|² + κ² (u(t + 1) - u(t))² + s²) - s over all voxels and times of `volumes` [T, Z, Y, X] (κ: `pace`; s:
    `smoothing`, positive), with its gradient; a time after another.

    Forward differences, which are zero at the last voxel of an axis and at the last time. (Rudin, Osher & Fatemi 1992;
    in space and time together: Wu et al. 2012, "Spatial-temporal total variation regularization".)
    """
    require(volumes.ndim == 4, f"volumes must have the shape [T, Z, Y, X], but it is {tuple(volumes.shape)}.")
    require(smoothing > 0, f"smoothing must be positive, but it is {smoothing:g}.")
    found = _SpaceTimeVariation.apply(volumes, pace, smoothing)
    assert isinstance(found, Tensor)
    return found


class _SpaceTimeVariation(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, volumes: Tensor, pace: float, smoothing: float) -> Tensor:  # type: ignore[override]
        slopes, total = torch.zeros_like(volumes), 0.0
        for k, volume in enumerate(volumes):
            later = pace * (volumes[k + 1] - volume) if k + 1 < len(volumes) else torch.zeros_like(volume)
            steps = [(axis, torch.diff(volume, dim=axis)) for axis in range(3) if volume.shape[axis] > 1]
            square = later.square().add_(smoothing**2)
            for axis, step in steps:
                square.narrow(axis, 0, step.shape[axis]).add_(step.square())
            size = square.sqrt_()
            total += float(size.sum(dtype=torch.float64)) - smoothing * size.numel()
            for axis, step in steps:
                count = step.shape[axis]
                slope = step / size.narrow(axis, 0, count)
                slopes[k].narrow(axis, 0, count).sub_(slope)
                slopes[k].narrow(axis, 1, count).add_(slope)
            if k + 1 < len(volumes):
                slope = later.div_(size).mul_(pace)
                slopes[k].sub_(slope)
                slopes[k + 1].add_(slope)
        ctx.slopes = slopes
        return volumes.new_tensor(total)

    @staticmethod
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor, None, None]:  # type: ignore[override]
        return upstream * ctx.slopes, None, None


def spectral_objective() -> Objective:
    """That of voxels of one time."""
    return Objective(l1=0.0, spectral=1.0, floor=0.1)


@checked_dataclass
class TimesFit:
    """How a field of space and time is fitted to the frames."""

    steps: Natural = 400
    """Steps of Adam."""
    decay: SomeShare = 0.1
    """Share of the rates that is left at the last step (exponential in between)."""
    drawn: DrawnTimes = field(default_factory=DrawnTimes)
    """Which times a step looks at."""
    weight: Weight = 0.05
    """Weight of total variation in space, in voxel edges of thickness, as voxels of one time have it."""
    noise_weight: Weight = 0.03
    """What it grows by for every pixel of thickness that the noise of the frames amounts to, for matter with levels;
    for other matter it falls with noise (`weight_of`)."""
    smoothing: Positive = 0.005
    """Differences between voxels below which total variation is a square."""
    objective: Objective = field(default_factory=spectral_objective)
    """How frames are compared."""


def weight_of(base: Ground, weight: float, noise_weight: float, bounded: bool) -> float:
    """The weight of total variation beside frames as noisy as those of `base`.

    bounded: whether the occupancy has an upper bound, as matter with levels has. Without one the weight falls with
    noise as those of the frames do at high frequencies, by 1 / (1 + f²), f the floor of `SpectralMisfit`, for nothing
    but the frames holds faint matter against total variation.
    """
    spectral = base.frames.spectral
    if spectral is None:
        return weight
    return weight + noise_weight * spectral.noise if bounded else weight / (1 + spectral.floor**2)


def frames_of_a_time(base: Ground) -> float:
    """How many there are, on average: misfits are means over frames."""
    return len(base.train) / len(base.train.instants)


def times_fit(
    task: Task,
    start: Stored,
    options: TimesFit,
    rates: Callable[[str], float],
    costs: Callable[[float], Sequence[Cost]] = lambda views: (),
) -> Fit:
    """The fit of `start`, whose matter at any time is voxels, to the training frames of `task`, made ready.

    Minimised is the mean over frames of the misfit, and λ/V times the mean over times of ∫ |∇u|, V frames a time, as
    for voxels of one time. rates: Adam's first rate of each parameter, by its name without `object.`; costs: what is
    added, each as a mean over times, by the number of frames of a time.
    """
    schedule = Schedule(steps=options.steps, decay=options.decay)
    base = ground(task.scan, start, start.matter, options.objective, schedule, "cpu", light=task.uneven)
    views, generator = frames_of_a_time(base), torch.Generator().manual_seed(task.seed)
    weight = weight_of(base, options.weight, options.noise_weight, task.bound(1.0) > 0)
    variation = Variation(weight / views, options.smoothing)
    term = SomeTimes(base.frames, base.train, options.drawn, (variation, *costs(views)), generator)
    problem = Problem(base.model, (term,))
    first = {name: rates(name.removeprefix("object.")) for name in problem.model.parameters()}

    def now(factor: float, step: int) -> Mapping[str, float]:
        return {name: rate * factor for name, rate in first.items()}

    return Fit(Plan(problem, schedule, lambda leaves: Adam(leaves, "cpu", {}), now, generator=generator), task.seed)
