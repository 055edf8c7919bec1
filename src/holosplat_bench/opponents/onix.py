"""Pixel-aligned networks: `onix`, δ and β through the waves, and `pixelnerf`, line integrals of attenuation alone.

A network that has seen many scenes by their frames alone (`holosplat train --network onix`), or none, says what is at
a point by what all views show in front of it; then its weights are fitted to the frames of this scan. The field itself
is `fields.PixelAlignedField`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import ClassVar, Self

import torch
from torch import Tensor

from holosplat.checks import require
from holosplat.fit.loop import Fit, Plan
from holosplat.fit.optimiser import Adam
from holosplat.fit.problem import Problem, Schedule, Term
from holosplat.fit.terms import Objective
from holosplat.geometry import Grid
from holosplat.learning.start import images, seen_in
from holosplat.matter import DeltaBeta, Matter
from holosplat.methods.cross_validation import assumed_material
from holosplat.methods.ground import ExtraTerm, ground
from holosplat.methods.method import Method, Stage, Task, one_material
from holosplat.methods.volume import binning
from holosplat.planning.needs import Costs, Needs, Sizes
from holosplat.ranges import Natural, Positive, Share, Weight, checked_dataclass
from holosplat.representations import Stored
from holosplat.scan import Scan

from .fields import AlignedNetwork, PixelAligned, PixelAlignedField
from .fields.neural_field import grown
from .fields.terms import AlignedFrames, AlignedLines
from .fields.weights import ONIX, PIXELNERF, read_aligned
from .neural_fields import visual_hull


class Bytes:
    """Of memory, that the parts of a field take (`benchmarks/needs.py`)."""

    points: float = 0.11e9
    """The points that are evaluated at once, and the weights."""
    voxel: float = 90.0
    """A voxel, of which two in five show matter: a fifth more is taken where all do."""
    place: float = 5.0
    """A voxel in a view: where its shadow lies."""
    features: float = 1500.0
    """A pixel of the images: what the encoder makes of it, with gradients."""


@checked_dataclass
class AlignedFit:
    """Options of a pixel-aligned field and its fit."""

    weights: str = ""
    """File of weights that `holosplat train --network` wrote (default: none; all is learnt from the scan's frames)."""
    network: AlignedNetwork = field(default_factory=AlignedNetwork)
    """How large the network is where no weights are given."""
    rate: Positive = 0.005
    """Adam's first rate of all weights."""
    weight: Weight = 0.01
    """Weight of total variation, in voxel edges of thickness."""
    noise_weight: Weight = 0.1
    """What it grows by for every pixel of thickness that the noise of the frames amounts to."""
    smoothing: Positive = 0.005
    """Differences between voxels below which total variation is a square."""
    hull: Share = 0.1
    """Share of the largest thickness that counts as matter: the field lives where all views show some."""
    margin: Natural = 2
    """Pixels around that."""
    max_voxels: Natural = 3_000_000
    """Frames are binned for the field rather than having more voxels than this: 144 pixels across."""
    objective: Objective = field(default_factory=lambda: Objective(l1=0.0, spectral=1.0, floor=0.1))
    """How frames are compared."""
    schedule: Schedule = field(default_factory=lambda: Schedule(steps=80, decay=0.1))
    """Of the fit; no steps leave what the network guesses."""
    terms: tuple[ExtraTerm, ...] = ()
    """Further terms by name."""

    def __post_init__(self) -> None:
        require(
            self.schedule.validation_views == 0,
            "a pixel-aligned field sees all training frames, so that none validates: validation_views must be 0, but "
            f"it is {self.schedule.validation_views}.",
        )

    def started(self, network: str, seed: int) -> tuple[AlignedNetwork, dict[str, Tensor]]:
        """The size and the weights of `network`: of the file, or drawn by `seed`; errors: those of `read_aligned`."""
        if self.weights:
            found = read_aligned(Path(self.weights), network)
            return found.size, found.weights
        return self.network, dict(PixelAligned(self.network, seed).named_parameters())


@dataclass(frozen=True)
class PixelAlignedMethod(Method):
    """A network that is the same for all scenes, then fitted to one; name: of its stage."""

    name: ClassVar[str]

    fit: AlignedFit = field(default_factory=AlignedFit)

    def stages(self) -> Sequence[Stage]:
        """The guess, and its fit."""
        return (AlignedStage(self.fit, self.kind, self.name),)

    def require_files(self) -> None:
        """Read the weights, where a file of them is named; errors: those of `read_aligned`."""
        if self.fit.weights:
            read_aligned(Path(self.fit.weights), self.kind)

    def with_effort(self, effort: float) -> Self:
        """The same method with `effort` times the steps, at least one."""
        return replace(self, fit=replace(self.fit, schedule=self.fit.schedule.with_effort(effort)))

    def needs(self, sizes: Sizes) -> Needs:
        """The field, its images and the waves (`planning.needs.Estimated`)."""
        small = sizes.joined(self.fit.max_voxels)
        seen = small.views * small.voxels
        memory = Bytes.points + Bytes.voxel * small.voxels + Bytes.place * seen + Bytes.features * small.pixels
        memory += Costs.waves * sizes.waves()
        return Needs(memory, small.voxels, 5 + 0.9e-6 * self.fit.schedule.steps * seen)


@dataclass(frozen=True)
class Onix(PixelAlignedMethod):
    """ONIX (Zhang et al. 2023) with waves: a network of δ and β that is the same for all scenes, then fitted to one."""

    kind: ClassVar[str] = ONIX
    name: ClassVar[str] = "pixel-aligned field through the waves"


@dataclass(frozen=True)
class PixelNerf(PixelAlignedMethod):
    """pixelNeRF (Yu et al. 2021) for line integrals of attenuation: as ONIX, but the fit knows no waves.

    It is fitted to what absorption alone would show, which phase retrieval makes of each frame by itself; frames in
    contact are that already.
    """

    kind: ClassVar[str] = PIXELNERF
    name: ClassVar[str] = "pixel-aligned field of line integrals"


ONIX_METHOD, PIXELNERF_METHOD = Onix(), PixelNerf()
"""As `METHODS` has them."""


@dataclass(frozen=True)
class AlignedStage:
    """What a network says of the scan, and its fit; network: `onix` or `pixelnerf`."""

    options: AlignedFit
    network: str
    name: str

    def start(self, task: Task, before: Stored | None) -> PixelAlignedField:
        """The guess: of one material, or with δ and β free where waves may tell them apart and nothing is known."""
        options, factor = self.options, binning(task.scan, self.options.max_voxels)
        scan = task.scan.binned(factor)
        material = assumed_material(scan, one_material(task), task.on_progress)
        matter = Matter.one(*material)
        if self.network == ONIX and not task.prior.fixes_ratio:
            matter = matter.freed()
        seen, thickness = seen_of(scan, material)
        grid = Grid.of_views(scan.views)
        mask = grown(visual_hull(thickness, scan.views, grid, options.hull), options.margin)
        size, weights = options.started(self.network, task.seed)
        upper = task.bound(1.0) if matter.single else 0.0
        return PixelAlignedField(weights, seen, scan.views, mask, grid, matter, network=size, upper=upper)

    def fit(self, task: Task, start: Stored) -> Fit | None:
        """The fit of the network's weights to the training frames; None for no steps."""
        assert isinstance(start, PixelAlignedField)
        return aligned_fit(task, start, self.options, self.network == ONIX) if self.options.schedule.steps else None


def seen_of(scan: Scan, material: DeltaBeta) -> tuple[Tensor, Tensor]:
    """The network's images [V, 3, H, W] of a scan, and the thickness of `material` [V, H, W] [pixels] in them."""
    contrast, thickness, noise = seen_in(scan, material)
    return images(contrast, thickness.float(), noise), thickness.float()


def aligned_fit(task: Task, start: PixelAlignedField, options: AlignedFit, waves: bool) -> Fit:
    """The fit of `start` to the training frames of `task`, through the waves or to retrieved line integrals."""
    factor = max(1, round(start.grid.voxel_size[0] / task.scan.views.finest))
    known, scan = task.uneven, task.scan.binned(factor)
    light = known and known.part(torch.arange(len(task.scan)), factor)
    base = ground(scan, start, start.matter, options.objective, options.schedule, "cpu", light=light)
    weight = base.in_noise(options.weight, options.noise_weight) / len(base.train)
    if waves:
        term: Term = AlignedFrames(base.frames, weight, options.smoothing)
    else:
        thickness = seen_of(scan, start.matter.channels[0])[1]
        term = AlignedLines(thickness, scan.views, weight, options.smoothing)
    names = base.model.parameters()
    plan = Plan(
        Problem(base.model, (term, *base.extra(options.terms))),
        options.schedule,
        lambda leaves: Adam(leaves, "cpu"),
        rates=lambda factor, step: dict.fromkeys(names, options.rate * factor),
        capture=False,
    )
    return Fit(plan, task.seed)
