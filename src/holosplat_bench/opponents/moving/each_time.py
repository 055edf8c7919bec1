"""All times of a scan, each by itself by a method for one time, or each from where its neighbour ended, or all
by total variation in space and time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np
import torch

from holosplat.baselines import HolographicTV, holographic_tv
from holosplat.checks import InputError, require
from holosplat.fit.loop import Fit, Plan
from holosplat.fit.problem import Problem, Schedule
from holosplat.fit.projected_gradient import ProjectedGradient
from holosplat.fit.terms import Objective
from holosplat.matter import MaterialPrior, Matter, MatterKind
from holosplat.methods.cross_validation import assumed_material
from holosplat.methods.ground import ground
from holosplat.methods.illumination import prepared
from holosplat.methods.method import Method, Stage, Task, finished, quiet, solve_stages
from holosplat.methods.solve import settled
from holosplat.progress import Progress
from holosplat.ranges import Natural, Positive, Weight, checked_dataclass
from holosplat.representations import Stored
from holosplat.scan import Scan

from ..pinn import FEWEST_TIMES
from .moving_voxels import VoxelSeries
from .times import AllTimes, SpaceTimeVariation4D, frames_of_a_time, spectral_objective, weight_of

EACH = "each time by itself"


@dataclass(frozen=True)
class Snapshots:
    """Objects of several times. times: [T] [s], in order; objects: of each."""

    times: np.ndarray
    objects: tuple[Stored, ...]

    def at(self, time: float) -> Stored:
        """The object of the time [s] that is nearest."""
        return self.objects[int(np.abs(self.times - time).argmin())]


def each_time(
    scan: Scan,
    prior: MaterialPrior,
    method: Method,
    seed: int = 0,
    matter: MatterKind | None = None,
    *,
    warm: bool = False,
    on_progress: Progress = quiet,
) -> Snapshots:
    """What `method`, which takes one time, makes of each time of the training frames of `scan`.

    matter: whether it has levels or is continuous; None: what the frames of the first time say, for all. warm: the
    last stage of the method fits each time but the first from what the time before it ended with, and no other stage
    is run there; what is not in sight at the first time can then only appear as far as that fit makes matter.
    Errors: `InputError` for a scan of one time, for a method of several times, with `warm` for one whose last stage
    fits nothing, and those of the method.
    """
    require(
        not method.of_series,
        f"each time by itself needs a method that takes one time, but {method.kind} takes several; choose another.",
    )
    train = scan.train()
    times, found = require_times(train), list[Stored]()
    first = prepared(Task(train.at_instant(0), prior, seed), method)
    chosen = settled(method, first, matter)
    for k in range(len(times)):
        on_progress(EACH, k / len(times))
        task = chosen.task(prepared(Task(train.at_instant(k), first.prior, seed), chosen.method))
        found.append(_gone_on(chosen.method, task, found[-1]) if warm and found else solve_stages(chosen.method, task))
    return Snapshots(times, tuple(found))


def _gone_on(method: Method, task: Task, before: Stored) -> Stored:
    """The last stage of `method`, from an object of another time."""
    fit = method.stages()[-1].fit(task, before)
    if fit is None:
        raise InputError(f"{method.kind} fits nothing that could begin at another time; choose a method that does.")
    fit.run(lambda record: None)
    return finished(fit)


def require_times(train: Scan) -> np.ndarray:
    """The times [T] [s] of training frames; `InputError` for fewer than two."""
    require(
        len(train.instants) >= FEWEST_TIMES,
        f"matter in motion needs training frames of {FEWEST_TIMES} times or more, but theirs are of one; give a scan "
        "of several times, or choose another method.",
    )
    return train.instants


def usual_start() -> HolographicTV:
    """On voxels of a pixel, and none beyond the field, so that all times have the same ones."""
    return HolographicTV(refine=1, beyond=False)


@dataclass(frozen=True)
class EachTimeStage:
    """The start of the other methods: a volume of each time by itself."""

    volume: HolographicTV
    name: str = EACH

    def start(self, task: Task, before: Stored | None) -> VoxelSeries:
        """The volumes; `InputError` for a scan of one time."""
        times = require_times(task.scan)
        middle = task.scan.at_instant(len(times) // 2)
        material = assumed_material(middle, task.prior, task.on_progress, self.volume.backend)
        bounded, volumes, grid = replace(self.volume, upper=task.bound(1.0)), list[torch.Tensor](), None
        for k in range(len(times)):
            task.on_progress(EACH, k / len(times))
            values, grid = holographic_tv(task.scan.at_instant(k), material, bounded, quiet)
            volumes.append(values.float())
        assert grid is not None
        return VoxelSeries(torch.stack(volumes), grid, times, Matter.one(*material), task.bound(1.0))

    def fit(self, task: Task, start: Stored) -> None:
        """Nothing is fitted."""


@dataclass(frozen=True)
class EachTime(Method):
    """Each time by itself, by phase retrieval and total variation, as one series of voxels."""

    kind: ClassVar[str] = "each-time"
    of_series: ClassVar[bool] = True

    volume: HolographicTV = field(default_factory=usual_start)

    def stages(self) -> tuple[Stage, ...]:
        """One, without a fit."""
        return (EachTimeStage(self.volume),)


@checked_dataclass
class SpaceTimeFit:
    """Options of voxels of all times and their fit."""

    steps: Natural = 60
    """Evaluations of the wave model of all frames and its gradient, as voxels of one time have."""
    weight: Weight = 0.05
    """Weight of total variation, in voxel edges of thickness, as voxels of one time have it."""
    noise_weight: Weight = 0.03
    """What it grows by for every pixel of thickness that the noise of the frames amounts to, for matter with levels;
    for other matter it falls with noise (`weight_of`)."""
    pace: Weight = 2.0
    """What a change from one time to the next counts beside one from a voxel to the next (0: times are apart); 0 to 1
    left more noise on the tuning snapshots."""
    smoothing: Positive = 0.005
    """Changes below which total variation is a square."""
    objective: Objective = field(default_factory=spectral_objective)
    """How frames are compared."""


@dataclass(frozen=True)
class SpaceTimeTV(Method):
    """Voxels of all times through the waves, with total variation in space and time."""

    kind: ClassVar[str] = "space-time-tv"
    of_series: ClassVar[bool] = True
    likelier: ClassVar[bool] = True

    volume: HolographicTV = field(default_factory=usual_start)
    fit: SpaceTimeFit = field(default_factory=SpaceTimeFit)

    def stages(self) -> Sequence[Stage]:
        """Each time by itself, and the fit."""
        return (EachTimeStage(self.volume), SpaceTimeStage(self.fit))


@dataclass(frozen=True)
class SpaceTimeStage:
    """The fit of the voxels of all times."""

    options: SpaceTimeFit
    name: str = "voxels of all times through the waves"

    def start(self, task: Task, before: Stored | None) -> Stored:
        """What came before."""
        assert before is not None
        return before

    def fit(self, task: Task, start: Stored) -> Fit:
        """The fit to the training frames, by the spectral projected gradient: it needs all frames in a step, of which
        one time at a time is held."""
        assert isinstance(start, VoxelSeries)
        options, schedule = self.options, replace(Schedule(), steps=self.options.steps)
        base = ground(task.scan, start, start.matter, options.objective, schedule, "cpu", light=task.uneven)
        weight = weight_of(base, options.weight, options.noise_weight, start.upper > 0) / frames_of_a_time(base)
        variation = SpaceTimeVariation4D(weight, options.pace, options.smoothing)
        problem, upper = Problem(base.model, (AllTimes(base.frames, base.train), variation)), start.upper
        plan = Plan(problem, schedule, lambda leaves: ProjectedGradient(leaves, upper or float("inf")))
        return Fit(plan, task.seed)
