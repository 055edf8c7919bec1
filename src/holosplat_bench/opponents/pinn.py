"""Fields of space and time whose matter and velocity obey equations of motion, fitted through the waves (a
physics-informed field, as in 4D-PIONIX, but on holograms and with splines for the matter)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

import torch

from holosplat.baselines import HolographicTV, holographic_tv
from holosplat.checks import require
from holosplat.fit.loop import Fit, Plan
from holosplat.fit.optimiser import Adam
from holosplat.fit.problem import Problem, Schedule, Term
from holosplat.fit.terms import Objective
from holosplat.matter import Matter
from holosplat.methods.cross_validation import assumed_material
from holosplat.methods.ground import ExtraTerm, Ground, ground
from holosplat.methods.method import Method, Stage, Task, one_material
from holosplat.planning.acts import Parts
from holosplat.planning.needs import Costs, Needs, Sizes, of_start
from holosplat.ranges import Natural, Positive, Weight, checked_dataclass
from holosplat.representations import Stored

from .fields import SpaceTime, SpaceTimeField
from .fields.space_time import FLOW
from .fields.terms import Equations, EquationTerm, SpaceTimeVariation

EACH, FLOW_ALONE, THROUGH_WAVES = "each time by itself", "flow of these", "field through the waves"
FEWEST_TIMES = 2
"""Times from which on something moves."""
OCCUPANCY = "object.coefficients"
"""The parameter of the matter; all others are the velocity's."""
SECOND_STAGE = 1_000_003
"""Added to the seed for the stage through the waves."""
LOOKED_AT = 60.0
"""Bytes of memory of a voxel that a step looks at, with gradients (`benchmarks/needs_acts.py`)."""
EVERY_TIME = 12.0
"""The same of each time, of the volumes that the field begins with."""


@checked_dataclass
class PinnFit:
    """Options of a space-time field and its fit."""

    space_time: SpaceTime = field(default_factory=SpaceTime)
    """The splines of the matter and the network of the velocity."""
    equations: Equations = field(default_factory=Equations)
    """What binds the two."""
    rate: Positive = 0.05
    """Adam's first rate of the coefficients of the matter, logarithms of odds."""
    flow_rate: Positive = 0.01
    """The same of the velocity's weights."""
    flow_steps: Natural = 150
    """Steps of the velocity alone, beside the matter of each time by itself."""
    weight: Weight = 0.05
    """Weight of total variation, in voxel edges of thickness."""
    noise_weight: Weight = 0.03
    """What it grows by for every pixel of thickness that the noise of the frames amounts to."""
    smoothing: Positive = 0.005
    """Differences between voxels below which total variation is a square."""
    objective: Objective = field(default_factory=lambda: Objective(l1=0.0, spectral=1.0, floor=0.1))
    """How frames are compared."""
    schedule: Schedule = field(default_factory=lambda: Schedule(steps=200, views_per_step=8, decay=0.1))
    """Of the stage through the waves."""
    terms: tuple[ExtraTerm, ...] = ()
    """Further terms by name, through the waves."""


@dataclass(frozen=True)
class Pinn(Method):
    """All times of a scan as one field of matter and velocity, bound by continuity and the equations of slow flow."""

    kind: ClassVar[str] = "pinn"
    of_series: ClassVar[bool] = True
    likelier: ClassVar[bool] = True

    volume: HolographicTV = field(default_factory=lambda: HolographicTV(refine=1))
    fit: PinnFit = field(default_factory=PinnFit)

    def stages(self) -> Sequence[Stage]:
        """Each time by itself, the flow that leads from one to the next where equations ask for one, and the fit."""
        begin = EachTime(self.volume, self.fit)
        if self.fit.equations.continuity == 0:
            return (begin, Waves(self.fit))
        return (begin, FlowAlone(self.fit), Waves(self.fit))

    def needs(self, sizes: Sizes) -> Needs:
        """Volumes of all times, and those that a step looks at (`planning.needs.Estimated`)."""
        one, times, drawn = replace(sizes, views=max(1, sizes.views // sizes.times)), sizes.times, self.fit.schedule
        step = replace(one, views=min(drawn.views_per_step or sizes.views, sizes.views))
        looked = min(step.views, times)
        fitted = (LOOKED_AT * looked + EVERY_TIME * times) * one.voxels + Costs.waves * step.waves()
        memory = max(Parts.drawn - Costs.program, fitted, of_start(one, self.volume))
        seconds = 20 + 2e-7 * drawn.steps * looked * one.voxels + 2e-4 * times * one.voxels
        return Needs(memory, one.voxels * times / 4, seconds)


PINN = Pinn()
"""As `METHODS` has it."""


@dataclass(frozen=True)
class EachTime:
    """The start: a volume of each time by itself."""

    volume: HolographicTV
    options: PinnFit
    name: str = EACH

    def start(self, task: Task, before: Stored | None) -> SpaceTimeField:
        """The field through the volumes of all times; `InputError` for a scan of one time."""
        times = task.scan.instants
        require(
            len(times) >= FEWEST_TIMES,
            f"pinn needs training frames of {FEWEST_TIMES} times or more, but theirs are of one; give a scan of "
            "several times, with --motion flow, or choose another method.",
        )
        middle = task.scan.at_instant(len(times) // 2)
        material = assumed_material(middle, one_material(task), task.on_progress, self.volume.backend)
        bounded, volumes = replace(self.volume, upper=task.bound(1.0)), list[torch.Tensor]()
        for k in range(len(times)):
            task.on_progress(EACH, k / len(times))
            scan = task.scan.at_instant(k)
            values, grid = holographic_tv(scan, material, bounded, lambda stage, part: None)
            volumes.append(values)
        matter = Matter.one(*material)
        return SpaceTimeField.still(
            torch.stack(volumes), grid, times, matter, self.options.space_time, task.seed, task.bound(1.0)
        )

    def fit(self, task: Task, start: Stored) -> None:
        """Nothing is fitted."""


@dataclass(frozen=True)
class GoesOn:
    """A stage that fits further what the one before has found."""

    options: PinnFit
    name: str

    def start(self, task: Task, before: Stored | None) -> Stored:
        """What came before."""
        assert before is not None
        return before


@dataclass(frozen=True)
class FlowAlone(GoesOn):
    """The velocity alone, by the equations: the matter stays as it is."""

    name: str = FLOW_ALONE

    def fit(self, task: Task, start: Stored) -> Fit:
        """The fit of the velocity."""
        options = self.options
        schedule = replace(options.schedule, steps=options.flow_steps, validation_views=0)
        base, generator = _ground(task, start, options, schedule), torch.Generator().manual_seed(task.seed)
        free = tuple(name for name in base.model.parameters() if name.startswith(f"object.{FLOW}"))
        problem = Problem(base.model, (_equations(task, options, generator),), free)
        return Fit(_plan(problem, schedule, options, generator), task.seed)


@dataclass(frozen=True)
class Waves(GoesOn):
    """Matter and velocity together, through the waves."""

    name: str = THROUGH_WAVES

    def fit(self, task: Task, start: Stored) -> Fit:
        """The fit of the field to the training frames."""
        options, schedule = self.options, self.options.schedule
        base = _ground(task, start, options, schedule)
        generator = torch.Generator().manual_seed(task.seed + SECOND_STAGE)
        times, views = base.train.instants, _views(base)
        weight = base.in_noise(options.weight, options.noise_weight)
        terms: list[Term] = [
            base.frames,
            SpaceTimeVariation(weight / views, options.smoothing, times.tolist(), generator),
            *base.extra(options.terms),
        ]
        bound = options.equations.continuity > 0
        if bound:
            terms.append(_equations(task, options, generator))
        problem = Problem(base.model, tuple(terms), None if bound else (OCCUPANCY,))
        return Fit(replace(_plan(problem, schedule, options, generator), judge=base.judge), task.seed)


def _ground(task: Task, start: Stored, options: PinnFit, schedule: Schedule) -> Ground:
    return ground(task.scan, start, start.matter, options.objective, schedule, "cpu", light=task.uneven)


def _views(base: Ground) -> float:
    """Frames of a time."""
    return len(base.train) / len(base.train.instants)


def _equations(task: Task, options: PinnFit, generator: torch.Generator) -> EquationTerm:
    times = task.scan.instants
    interval = float(times[-1] - times[0]) / (len(times) - 1)
    return EquationTerm(options.equations, len(task.scan) / len(times), interval, generator)


def _plan(problem: Problem, schedule: Schedule, options: PinnFit, generator: torch.Generator) -> Plan:
    names = problem.free or tuple(problem.model.parameters())
    first = {name: options.rate if name == OCCUPANCY else options.flow_rate for name in names}
    return Plan(
        problem=problem,
        schedule=schedule,
        optimiser=lambda leaves: Adam(leaves, "cpu", {}),
        rates=lambda factor, step: {name: rate * factor for name, rate in first.items()},
        generator=generator,
    )
