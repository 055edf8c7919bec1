"""Voxels of all times at once, fitted through the waves with total variation in space and time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

from holosplat.baselines import HolographicTV
from holosplat.checks import at_least, require
from holosplat.fit.loop import Fit, Plan
from holosplat.fit.problem import Problem
from holosplat.fit.projected_gradient import ProjectedGradient
from holosplat.fit.schedule import Schedule
from holosplat.fit.terms import Objective
from holosplat.methods.ground import ground
from holosplat.methods.method import Method, Stage, Task
from holosplat.ranges import Weight, ranged
from holosplat.representations import Stored

from .each_time import EachTimeStage, usual_start
from .moving_voxels import VoxelSeries
from .through_waves import frames_of_a_time, spectral_objective, weight_of
from .times import AllTimes, SpaceTimeVariation4D


@dataclass(frozen=True)
@ranged
class SpaceTimeFit:
    """Options of voxels of all times and their fit."""

    steps: int = 60
    """Evaluations of the wave model of all frames and its gradient, as voxels of one time have."""
    weight: Weight = 0.05
    """Weight of total variation, in voxel edges of thickness, as voxels of one time have it."""
    noise_weight: Weight = 0.03
    """What it grows by for every pixel of thickness that the noise of the frames amounts to, for matter with levels;
    for other matter it falls with noise (`weight_of`)."""
    pace: Weight = 2.0
    """What a change from one time to the next counts beside one from a voxel to the next (0: times are apart); 0 to 1
    left more noise on the tuning snapshots."""
    smoothing: float = 0.005
    """Changes below which total variation is a square."""
    objective: Objective = field(default_factory=spectral_objective)
    """How frames are compared."""

    def __post_init__(self) -> None:
        at_least(self, 1, "steps")
        require(self.smoothing > 0, f"smoothing must be positive, but it is {self.smoothing:g}.")


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
