"""Holograms taken for photographs: Gaussian splatting and a plain NeRF, both from a random start. No waves.

Both are opponents of the benchmark that show what the waves are worth. They fit intensities, and never hear of
distances, energies or a material. What they find is opaque and shines, so that it says nothing of δ by itself, which is
read off so: δ is the density times the one factor by which its line integrals agree best (least squares) with the
thickness that Paganin's filter finds in the same training frames. The truth is not looked at.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

import torch
from torch import Tensor

from holosplat.checks import require
from holosplat.fit.density import DensityControl, DensityEvent
from holosplat.fit.loop import Fit, Plan, Stateless
from holosplat.fit.optimiser import Adam, Trainable
from holosplat.fit.problem import FIXED, Batch, LossPart, Problem, Schedule
from holosplat.fit.terms import Objective
from holosplat.geometry import Grid
from holosplat.matter import Matter
from holosplat.methods.cross_validation import assumed_material
from holosplat.methods.gaussian_options import GaussianRates
from holosplat.methods.ground import ground
from holosplat.methods.method import Method, Stage, Task
from holosplat.model import Instrument, Model
from holosplat.optics.retrieval import paganin
from holosplat.ranges import Natural, Positive, Rate, Share, checked_dataclass
from holosplat.representations import Stored
from holosplat.scan import Scan

from .fields import Encoding, Network
from .fields.neural_field import uniform
from .photographed import AlphaCloud, RadianceField


@checked_dataclass
class AlphaRates(GaussianRates):
    """Adam's rates at the start of a fit; `raw_amplitudes` are the opacities before the logistic function."""

    centres: Rate = 0.05
    """Of the centres [detector pixels]."""
    log_scales: Rate = 0.01
    """Of the logarithms of the axes."""
    quaternions: Rate = 0.01
    """Of the orientations."""
    raw_amplitudes: Rate = 0.05
    """Of the opacities before the logistic function (0.05 as published)."""
    raw_greys: Rate = 0.03
    """Of the grey values before the logistic function."""


def _density() -> DensityControl:
    return DensityControl(every=50, stop=0.5, faint=0.005, max_count=20_000)


@checked_dataclass
class AlphaSplats(Method):
    """3D Gaussian splatting (Kerbl et al. 2023): random Gaussians, cloned, split and pruned, each with a grey value.

    Left out are grey values that depend on the direction of view, and the resets of opacities.
    """

    kind: ClassVar[str] = "alpha-3dgs"

    start_per_pixel: Positive = 0.2
    """Gaussians at the start for each pixel of a frame, uniform in the ball that every view sees."""
    similarity: Share = 0.2
    """Share of 1 - SSIM in the loss, beside the mean absolute difference (0.2 as published)."""
    schedule: Schedule = field(default_factory=lambda: Schedule(1000, views_per_step=1, decay=0.01, oversample=1))
    """Steps, each on one frame as published."""
    rates: AlphaRates = field(default_factory=AlphaRates)
    """Adam's rates."""
    density: DensityControl = field(default_factory=_density)
    """Where Gaussians come and go; children keep the opacity of their parent, as published."""

    reset_every: int = 200
    """Steps between resets of all opacities (0: never)."""
    reset_to: Share = 0.01
    """Opacity that is left then, at most (0.01 as published)."""

    @property
    def wants_levels(self) -> bool:
        """It does not matter."""
        return False

    def stages(self) -> Sequence[Stage]:
        """The fit, and δ."""
        return (SplatStage(self), ReadDelta())

    def with_effort(self, effort: float) -> AlphaSplats:
        """The same method with `effort` times the steps, at least one."""
        steps = max(1, round(effort * self.schedule.steps))
        every, reset = (max(1, round(effort * n)) for n in (self.density.every, self.reset_every))
        schedule, density = replace(self.schedule, steps=steps), replace(self.density, every=every)
        return replace(self, schedule=schedule, density=density, reset_every=reset)


class OpacityResets(Stateless):
    """An event of a fit of splats: every so many steps all become faint, and those that frames need come back."""

    def __init__(self, every: int, opacity: float) -> None:
        self._every, self._raw = every, math.log(opacity / (1 - opacity))

    def after_step(self, trainable: Trainable, step: int, steps: int, generator: torch.Generator) -> bool:
        """Reset, where it is due; not in the second half, in which opacities come back."""
        if self._every and (step + 1) % self._every == 0 and step + 1 < 0.5 * steps:
            with torch.no_grad():
                trainable.leaves["object.raw_amplitudes"].clamp_(max=self._raw)
        return False


@dataclass(frozen=True)
class SplatStage:
    """A random start, and the fit of photographs."""

    options: AlphaSplats
    name: str = "splats as photographs"

    def start(self, task: Task, before: Stored | None) -> AlphaCloud:
        """Random Gaussians; what their matter is, is not known yet."""
        matter = Matter.one(*assumed_material(task.scan, task.prior, task.on_progress))
        frames = torch.from_numpy(task.scan.frames)
        count = max(1, round(self.options.start_per_pixel * frames[0].numel()))
        return AlphaCloud.random(count, task.scan.views, frames, matter, task.seed)

    def fit(self, task: Task, start: Stored) -> Fit:
        """The fit to the training frames."""
        assert isinstance(start, AlphaCloud)
        how, share = self.options, self.options.similarity
        objective = Objective(l1=1 - share, ssim=share)
        base = ground(task.scan, start.on("cpu"), start.matter, objective, how.schedule, "cpu")
        plan = Plan(
            Problem(base.model, (base.frames,)),
            how.schedule,
            lambda leaves: Adam(leaves, "cpu"),
            rates=lambda factor, step: how.rates.at(factor, True),
            events=(DensityEvent(how.density, base.train.views), OpacityResets(how.reset_every, how.reset_to)),
            judge=base.judge,
        )
        return Fit(plan, task.seed)


def _network() -> Network:
    return Network(Encoding(kind="octaves"), hidden=64, layers=3)


@checked_dataclass
class RadianceFields(Method):
    """A plain NeRF (Mildenhall et al. 2020): positional encoding, a perceptron, and emission and absorption on rays.

    Left out are grey values that depend on the direction of view, and the second, finer network.
    """

    kind: ClassVar[str] = "nerf"

    network: Network = field(default_factory=_network)
    """Waves whose periods halve down to about 2 pixels, and three layers of 64 units behind them."""
    rays: Natural = 256
    """Rays of all frames in a step."""
    rate: Rate = 0.005
    """Adam's first rate of all weights."""
    schedule: Schedule = field(default_factory=lambda: Schedule(1000, decay=0.1, oversample=1))
    """Steps; they look at rays of all frames."""

    @property
    def wants_levels(self) -> bool:
        """It does not matter."""
        return False

    def stages(self) -> Sequence[Stage]:
        """The fit, and δ."""
        return (RadianceStage(self), ReadDelta())

    def with_effort(self, effort: float) -> RadianceFields:
        """The same method with `effort` times the steps, at least one."""
        steps = max(1, round(effort * self.schedule.steps))
        return replace(self, schedule=replace(self.schedule, steps=steps))


@dataclass(frozen=True)
class RadianceStage:
    """A random network, and the fit of photographs."""

    options: RadianceFields
    name: str = "radiance field"

    def start(self, task: Task, before: Stored | None) -> RadianceField:
        """A random field in the box of all views; what its matter is, is not known yet."""
        matter = Matter.one(*assumed_material(task.scan, task.prior, task.on_progress))
        frames = torch.from_numpy(task.scan.frames)
        return RadianceField.filling(Grid.of_views(task.scan.views), frames, matter, self.options.network, task.seed)

    def fit(self, task: Task, start: Stored) -> Fit:
        """The fit to the training frames."""
        assert isinstance(start, RadianceField)
        how, train, generator = self.options, task.scan.train(), torch.Generator().manual_seed(task.seed)
        model = Model(start, Instrument(train.exposures))
        names = model.parameters()
        plan = Plan(
            Problem(model, (RandomRays(train, how.rays, generator),)),
            how.schedule,
            lambda leaves: Adam(leaves, "cpu"),
            rates=lambda factor, step: dict.fromkeys(names, how.rate * factor),
            generator=generator,
        )
        return Fit(plan, task.seed)


@dataclass(frozen=True)
class ReadDelta:
    """δ and β by the density, one factor for all of it (see the top of this module)."""

    name: str = "δ read off"

    def start(self, task: Task, before: Stored | None) -> Stored:
        """The same object of matter whose line integrals are nearest to the retrieved thickness.

        Errors: `InputError` where the density has nothing in common with that.
        """
        assert isinstance(before, AlphaCloud | RadianceField)
        material, scan = before.matter.channels[0], task.scan
        thickness = paganin(torch.from_numpy(scan.frames), scan.exposures, *material)
        with torch.no_grad():
            _, found = before.project(scan.views)
        found = found.double() / material.delta
        agreement = float((found * thickness).sum())
        require(
            agreement > 0, "the density found has nothing in common with the matter in the frames; take more steps."
        )
        factor = agreement / float(found.square().sum())
        return before.made_of(Matter.one(*(factor * value for value in material)))

    def fit(self, task: Task, start: Stored) -> None:
        """There is none."""


class RandomRays:
    """Mean squared difference of intensities on rays drawn anew in every step (Mildenhall et al. 2020, eq. 6).

    count: of all rays in a step, as many of each frame.
    """

    names = ("rays",)
    resolved = FIXED

    def __init__(self, train: Scan, count: int, generator: torch.Generator) -> None:
        self._views, self._generator = train.views, generator
        self._frames = torch.from_numpy(train.frames).flatten(1)
        self._of_each = max(1, round(count / len(train)))

    def __call__(self, model: Model, batch: Batch) -> Sequence[LossPart]:
        """The one part."""
        field, generator = model.object, self._generator
        assert isinstance(field, RadianceField)
        positions, rays, measured = list[Tensor](), list[Tensor](), self._frames.new_zeros(0)
        for v, frame in enumerate(self._frames):
            chosen = (uniform(generator, self._of_each) * len(frame)).long().unique()
            at, ray = field.along(self._views, v, chosen, generator)
            positions.append(at)
            rays.append(ray + len(measured))
            measured = torch.cat((measured, frame[chosen]))
        found = field.intensities(torch.cat(positions), torch.cat(rays), len(measured))
        return [LossPart("rays", 1.0, (found - measured).square().mean())]
