"""What fits of moving matter to frames of a few times a step have in common."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import torch

from holosplat.checks import at_least, require
from holosplat.fit.loop import Fit, Plan
from holosplat.fit.optimiser import Adam
from holosplat.fit.problem import Problem
from holosplat.fit.schedule import Schedule
from holosplat.fit.terms import Objective
from holosplat.methods.ground import Ground, ground
from holosplat.methods.method import Task
from holosplat.ranges import Weight, ranged
from holosplat.representations import Stored

from .times import Cost, DrawnTimes, SomeTimes, Variation


def spectral_objective() -> Objective:
    """That of voxels of one time."""
    return Objective(l1=0.0, spectral=1.0, floor=0.1)


@dataclass(frozen=True)
@ranged
class TimesFit:
    """How a field of space and time is fitted to the frames."""

    steps: int = 400
    """Steps of Adam."""
    decay: float = 0.1
    """Share of the rates that is left at the last step (exponential in between)."""
    drawn: DrawnTimes = field(default_factory=DrawnTimes)
    """Which times a step looks at."""
    weight: Weight = 0.05
    """Weight of total variation in space, in voxel edges of thickness, as voxels of one time have it."""
    noise_weight: Weight = 0.03
    """What it grows by for every pixel of thickness that the noise of the frames amounts to, for matter with levels;
    for other matter it falls with noise (`weight_of`)."""
    smoothing: float = 0.005
    """Differences between voxels below which total variation is a square."""
    objective: Objective = field(default_factory=spectral_objective)
    """How frames are compared."""

    def __post_init__(self) -> None:
        at_least(self, 1, "steps")
        require(self.smoothing > 0, f"smoothing must be positive, but it is {self.smoothing:g}.")
        require(0 < self.decay <= 1, f"decay must lie in (0, 1], but it is {self.decay:g}.")


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
