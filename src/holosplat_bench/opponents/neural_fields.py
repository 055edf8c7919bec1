"""Neural fields: fitted to retrieved thickness on random rays first, then through the full wave model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from holosplat.backends import Backend, device, resolve
from holosplat.baselines import HolographicTV
from holosplat.checks import require
from holosplat.fit.loop import Fit, Plan
from holosplat.fit.optimiser import Adam, Group, Leaves, Trainable
from holosplat.fit.problem import Problem, Schedule
from holosplat.fit.run import Record
from holosplat.fit.terms import Objective
from holosplat.geometry import Grid, Poses, Views
from holosplat.matter import Matter
from holosplat.methods.ground import ExtraTerm, ground
from holosplat.methods.method import Method, Stage, Task, run_quietly
from holosplat.methods.voxels import HolographicStage
from holosplat.model import Model
from holosplat.optics.background import Light
from holosplat.planning.needs import Needs, Sizes, of_grid
from holosplat.ranges import Natural, Positive, Weight, checked_dataclass
from holosplat.representations import Stored, VoxelGrid
from holosplat.scan import Scan

from .fields import NeuralField
from .fields.neural_field import Network, grown
from .fields.terms import FieldVariation, RetrievedThickness

WARM_UP, THROUGH_WAVES = "field for the retrieved thickness", "field through the waves"
BETAS, EPSILON = (0.9, 0.99), 1e-15
"""Adam's constants (Müller et al. 2022, section 4)."""
PEAK = 0.995
"""Quantile of the retrieved thickness that counts as its largest value: single pixels may be artefacts."""
SECOND_STAGE = 1_000_003
"""Added to the seed for the stage through the waves."""


@checked_dataclass
class NeuralFit:
    """Options of a neural field and its fit."""

    network: Network = field(default_factory=Network)
    """The encoding and the network behind it."""
    warmup_steps: int = 80
    """Steps towards the retrieved thickness."""
    warmup_rays: Natural = 4096
    """Rays of all views in each of them."""
    rate: Positive = 0.02
    """Adam's first rate of all weights, in either stage."""
    shrinkage: Weight = 0.01
    """Weight decay of the encoding."""
    weight: Weight = 0.01
    """Weight of total variation, in voxel edges of thickness."""
    noise_weight: Weight = 0.1
    """What it grows by for every pixel of thickness that the noise of the frames amounts to."""
    probes: Natural = 4096
    """Random pairs of points half a pixel apart on which total variation is measured."""
    hull: Weight = 0.1
    """Share of the largest retrieved thickness that counts as matter: the field lives where all views show matter."""
    margin: int = 2
    """Pixels around that, and around what is kept."""
    prune_every: int = 75
    """Steps between updates of where the field is looked at (0: never)."""
    empty: Weight = 0.1
    """Value up to which nothing is there, in these updates."""
    objective: Objective = field(default_factory=lambda: Objective(l1=0.0, spectral=1.0, floor=0.1))
    """How frames are compared."""
    schedule: Schedule = field(default_factory=lambda: Schedule(steps=250, views_per_step=1, decay=0.05))
    """Of the stage through the waves; `seconds` is the limit of both stages together, half of it each."""
    terms: tuple[ExtraTerm, ...] = ()
    """Further terms by name, through the waves."""
    backend: Backend = "cpu"
    """What computes both stages; `cuda` pays for large fields only."""

    def __post_init__(self) -> None:
        steps = self.warmup_steps + self.schedule.steps
        require(steps > 0, "a fit needs steps: warmup_steps or schedule.steps must be positive.")


@dataclass(frozen=True)
class NeuralFields(Method):
    """A neural field that learns the line integrals of `HolographicTV`, and is then fitted to the frames."""

    kind: ClassVar[str] = "neural-field"
    any_backend: ClassVar[bool] = True
    two_sided: ClassVar[bool] = True

    volume: HolographicTV = field(default_factory=HolographicTV)
    fit: NeuralFit = field(default_factory=NeuralFit)

    def stages(self) -> Sequence[Stage]:
        """The start, and the field, which learns the start's thickness before its fit."""
        return (HolographicStage(self.volume), NeuralStage(self.fit))

    def with_effort(self, effort: float) -> NeuralFields:
        """The same method with `effort` times the steps, at least one."""
        first, schedule = max(1, round(effort * self.fit.warmup_steps)), self.fit.schedule.with_effort(effort)
        return replace(self, fit=replace(self.fit, warmup_steps=first, schedule=schedule))

    def needs(self, sizes: Sizes) -> Needs:
        """As of voxels (`planning.needs.Estimated`)."""
        return of_grid(sizes, self.volume)


NEURAL_FIELD = NeuralFields()
"""As `METHODS` has it."""


@dataclass(frozen=True)
class NeuralStage:
    """A field that has learned the thickness of what came before, fitted to the frames."""

    options: NeuralFit
    name: str = THROUGH_WAVES

    def start(self, task: Task, before: Stored | None) -> NeuralField:
        """The field after its warm-up, in the visual hull of what came before."""
        assert isinstance(before, VoxelGrid)
        matter = before.matter if task.prior.fixes_ratio or not before.matter.single else before.matter.freed()
        thickness = before.project(task.scan.views).channels[:, 0].detach()
        return warmed_up(task, matter, thickness, self.options)

    def fit(self, task: Task, start: Stored) -> Fit | None:
        """The fit to the frames, or None for no steps."""
        assert isinstance(start, NeuralField)
        return (
            waves_fit(task.scan, start, self.options, task.seed, task.uneven) if self.options.schedule.steps else None
        )


def warmed_up(task: Task, matter: Matter, thickness: Tensor, options: NeuralFit) -> NeuralField:
    """A field of `matter` that has learned thickness [V, H, W] [m] of the training frames on random rays.

    Errors: `InputError` if the thickness is of another shape than the frames, or has nothing in common in all views.
    """
    views, wanted = task.scan.views, task.scan.frames.shape
    require(
        tuple(thickness.shape) == tuple(wanted),
        f"thickness must have the shape of the training frames {tuple(wanted)}, but it has {tuple(thickness.shape)}.",
    )
    two_sided = task.prior.two_sided
    hull = grown(visual_hull(thickness, views, Grid.of_views(views), options.hull, two_sided), options.margin)
    upper = task.bound(1.0) if matter.single else 0.0
    field = NeuralField(Grid.of_views(views), matter, options.network, hull, task.seed, upper, lower=task.prior.lower)
    if options.warmup_steps == 0:
        return field
    fit = _warm_up(task.scan, field, (thickness / field.pitch).float(), options, task.seed)
    return run_quietly(fit, task.report(WARM_UP), NeuralField)


def _warm_up(scan: Scan, field: NeuralField, target: Tensor, options: NeuralFit, seed: int) -> Fit:
    backend = resolve(options.backend)
    generator = torch.Generator(device(backend)).manual_seed(seed)
    share = min(1.0, options.warmup_rays / target.numel())
    steps = options.warmup_steps
    schedule = replace(options.schedule, steps=steps, views_per_step=0, validation_views=0)
    base = ground(scan, field.on(backend), field.matter, options.objective, schedule, backend)
    terms = (
        RetrievedThickness(target.to(generator.device), scan.views, share, generator),
        FieldVariation(base.in_noise(options.weight, options.noise_weight), options.probes, generator),
    )
    return Fit(_plan(Problem(base.model, terms), schedule, options, generator), seed)


def waves_fit(scan: Scan, field: NeuralField, options: NeuralFit, seed: int = 0, light: Light | None = None) -> Fit:
    """The fit of `field` to the training frames of `scan`, made ready."""
    backend = resolve(options.backend)
    generator = torch.Generator(device(backend)).manual_seed(seed + SECOND_STAGE)
    drawn = field.on(backend)
    drawn.jitter = generator
    base = ground(scan, drawn, field.matter, options.objective, options.schedule, backend, light=light)
    weight = base.in_noise(options.weight, options.noise_weight) / len(base.train)
    variation = FieldVariation(weight, options.probes, generator)
    problem = Problem(base.model, (base.frames, variation, *base.extra(options.terms)))
    plan = _plan(problem, options.schedule, options, generator)
    return Fit(replace(plan, judge=base.judge), seed)


def _plan(problem: Problem, schedule: Schedule, options: NeuralFit, generator: torch.Generator) -> Plan:
    field = problem.model.object
    assert isinstance(field, NeuralField)
    groups = {
        f"object.{name}": Group(BETAS, EPSILON, options.shrinkage if name.startswith("encoding.") else 0.0)
        for name in field.parameters()
    }
    return Plan(
        problem=problem,
        schedule=replace(schedule, seconds=0.5 * schedule.seconds),
        optimiser=lambda leaves: Adam(leaves, problem.model.instrument.backend, groups),
        rates=lambda factor, step: dict.fromkeys(groups, options.rate * factor),
        events=(PruneEvent(options, field),),
        generator=generator,
        capture=False,  # how many samples a step has depends on the mask
    )


class PruneEvent:
    """Every so many steps, a field is looked at only where its values are not nothing, within its first hull."""

    def __init__(self, options: NeuralFit, field: NeuralField) -> None:
        """field: whose mask all its copies share."""
        self._options, self._hull, self._field = options, field.mask.clone(), field

    def on_gradients(self, leaves: Leaves) -> None:
        """Nothing."""

    def after_step(self, trainable: Trainable, step: int, steps: int, generator: torch.Generator) -> bool:
        """Prune, where it is due."""
        every, field = self._options.prune_every, trainable.model.object
        assert isinstance(field, NeuralField)
        if every == 0 or (step + 1) % every or step + 1 >= steps:
            return False
        field.prune(self._options.empty, self._options.margin, self._hull)
        return True

    def columns(self, model: Model) -> Record:
        """The number of voxels that are looked at."""
        assert isinstance(model.object, NeuralField)
        return {"occupied": float(model.object.mask.sum())}

    def state_dict(self) -> dict[str, Any]:
        """The hull and the mask."""
        return {"hull": self._hull.cpu().clone(), "mask": self._field.mask.cpu().clone()}

    def load(self, state: dict[str, Any]) -> None:
        """Go back to a saved state; the field of the fit shares the mask."""
        self._hull = state["hull"].to(self._field.mask.device)
        self._field.look_at(state["mask"])


def visual_hull(thickness: Tensor, views: Views, grid: Grid, share: float, two_sided: bool = False) -> Tensor:
    """Voxels [Z, Y, X] of `grid` in front of pixels with matter in all views; a pixel's neighbours count with it.

    thickness: [V, H, W]; matter is what exceeds `share` of its largest value. Voxels that a view misses do not count.
    two_sided: whether matter lies on both sides of its medium: it may cancel along a ray, and so no pixel is without.
    """
    level = share * float(np.quantile(thickness.cpu().numpy(), PEAK))
    matter = torch.ones_like(thickness, dtype=torch.bool) if two_sided else thickness > level
    shown = max_pool2d(matter[:, None].float(), 3, stride=1, padding=1)[:, 0] > 0
    x, y, z = (torch.from_numpy(axis / views.pitch) for axis in grid.axes())
    hull = torch.ones(grid.shape, dtype=torch.bool)
    h, w = views.shape
    poses = Poses.of(views)
    for image, rotation, shift in zip(shown, poses.matrices.numpy(), poses.offsets.numpy() / views.pitch):
        column, row = (
            (a[2] * z[:, None, None] + a[1] * y[:, None] + a[0] * x - s + 0.5 * n).floor().long()
            for a, s, n in zip(rotation, shift, (w, h))
        )
        inside = (column >= 0) & (column < w) & (row >= 0) & (row < h)
        hull &= inside & image.cpu()[row.clamp(0, h - 1), column.clamp(0, w - 1)]
    require(bool(hull.any()), "the retrieved thickness of the views has no matter in common; lower hull, or check it.")
    return hull
