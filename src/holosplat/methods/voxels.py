"""Voxels: total variation made to agree with the holograms, and voxels fitted through the full wave model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

import torch

from ..baselines import HolographicTV, holographic_tv
from ..baselines.beyond import margins_of
from ..checks import require
from ..fit.loop import Fit, Plan
from ..fit.optimiser import Leaves
from ..fit.problem import Problem, Schedule
from ..fit.projected_gradient import ProjectedGradient
from ..fit.terms import Objective
from ..fit.terms.object import VoxelVariation
from ..geometry import Grid
from ..matter import Matter
from ..optics.background import Light
from ..optics.sampling import fringe_sampling
from ..ranges import Natural, Positive, Weight, checked_dataclass
from ..representations import Stored, VoxelGrid
from ..scan import Scan
from .cross_validation import assumed_material
from .ground import ExtraTerm, ground
from .method import Method, Stage, Task, one_material

ABSORPTION_REACH = 10.0
"""How much longer than those of δ the steps of a free β are, in units of the material's. At equal lengths β would not
move, for it changes the frames a thousand times less; at lengths for equal changes it would fit the noise."""


@dataclass(frozen=True)
class HolographicVoxels(Method):
    """Phase retrieval and total variation, made to agree with the holograms: the start of the Gaussians, by itself."""

    kind: ClassVar[str] = "holographic-tv"
    cones: ClassVar[bool] = True
    any_backend: ClassVar[bool] = True
    two_sided: ClassVar[bool] = True

    volume: HolographicTV = field(default_factory=HolographicTV)

    def stages(self) -> tuple[Stage, ...]:
        """One, without a fit."""
        return (HolographicStage(self.volume),)


@dataclass(frozen=True)
class HolographicStage:
    """The start that Gaussians, voxels and neural fields share."""

    options: HolographicTV
    name: str = "holographic total variation"

    def start(self, task: Task, before: Stored | None) -> VoxelGrid:
        """Occupancies of the one material that all matter is taken for."""
        material = assumed_material(task.scan, one_material(task), task.on_progress, self.options.backend)
        bounded = replace(self.options, upper=task.bound(1.0), two_sided=task.prior.two_sided)
        values, grid = holographic_tv(task.scan, material, bounded, task.on_progress, task.unlike_null)
        return VoxelGrid(values[None], grid, Matter.one(*material))

    def fit(self, task: Task, start: Stored) -> None:
        """Nothing is fitted."""


@checked_dataclass
class VoxelFit:
    """Options of voxels fitted through the waves."""

    coarse_steps: int = 0
    """Evaluations of the wave model and its gradient with one voxel a pixel, before the finest voxels."""
    steps: Natural = 60
    """Evaluations with the finest voxels."""
    weight: Weight = 0.05
    """Weight of total variation, in voxel edges of thickness."""
    noise_weight: Weight = 0.03
    """What it grows by for every pixel of thickness that the noise of the frames amounts to."""
    smoothing: Positive = 0.005
    """Differences between voxels below which total variation is a square."""
    upper: Weight = 1.0
    """Bound of the occupancy of a known material (0: none)."""
    refine: int = 0
    """Voxels along a pixel's edge (0: as the first fringe needs)."""
    max_voxels: Natural = 20_000_000
    """Coarser voxels rather than more than this many."""
    objective: Objective = field(default_factory=lambda: Objective(l1=0.0, spectral=1.0, floor=0.1))
    """How frames are compared."""
    schedule: Schedule = field(default_factory=Schedule)
    """The loop's options but for the number of steps, which is above; all frames are looked at in every step."""
    terms: tuple[ExtraTerm, ...] = ()
    """Further terms by name."""

    def __post_init__(self) -> None:
        require(
            self.schedule.views_per_step == 0,
            f"voxels need views_per_step = 0, all frames in every step, but it is {self.schedule.views_per_step}.",
        )


@dataclass(frozen=True)
class Voxels(Method):
    """The method that fits voxels to the frames with total variation; δ and β are free where the material is unknown.

    Examples:

        >>> import holosplat as hs
        >>> water = hs.materials.parse_material("water").delta_beta(20.0)
        >>> views = hs.Views.evenly_spaced(8, shape=(16, 16), pixel_size=1e-6)
        >>> cells = hs.specimens.random_cells(1, box=(16e-6, 16e-6, 16e-6), seed=1)
        >>> scene = hs.MeshScene.of_one_material(cells, water)
        >>> scan = hs.simulate(scene, hs.Exposures.of(views, energy_kev=20.0, distance=0.05))
        >>> result = hs.reconstruct(scan, hs.MaterialPrior.of_ratio(water.ratio), hs.Voxels())
        >>> result.object.voxelise(hs.Grid.of_views(views)).delta.shape
        (16, 16, 16)
    """

    kind: ClassVar[str] = "voxels"
    cones: ClassVar[bool] = True
    two_sided: ClassVar[bool] = True

    volume: HolographicTV = field(default_factory=HolographicTV)
    fit: VoxelFit = field(default_factory=VoxelFit)

    def stages(self) -> Sequence[Stage]:
        """The start, coarse voxels where steps are given to them, and the finest ones."""
        coarse = [VoxelStage(self.fit, coarse=True)] if self.fit.coarse_steps else []
        return (HolographicStage(self.volume), *coarse, VoxelStage(self.fit))

    def with_effort(self, effort: float) -> Voxels:
        """The same method with `effort` times the steps, at least one."""
        return replace(self, fit=replace(self.fit, steps=max(1, round(effort * self.fit.steps))))


@dataclass(frozen=True)
class VoxelStage:
    """A fit of voxels of one size."""

    options: VoxelFit
    coarse: bool = False

    @property
    def name(self) -> str:
        """For progress and summaries."""
        return "voxels through the waves" + (", coarse" if self.coarse else "")

    def start(self, task: Task, before: Stored | None) -> VoxelGrid:
        """What came before on the voxels of this stage, with δ and β apart where nothing is known."""
        assert isinstance(before, VoxelGrid)
        free = before.matter.single and not task.prior.fixes_ratio
        refine = 1 if self.coarse else refinement(task.scan, self.options)
        grid = (before.freed() if free else before).resampled(
            Grid.of_views(task.scan.views.padded(margins_of(before.grid, task.scan.views)), refine)
        )
        return grid.with_parameters({"values": grid.values.detach().float()})

    def fit(self, task: Task, start: Stored) -> Fit:
        """The fit of the voxels to the training frames."""
        assert isinstance(start, VoxelGrid)
        options = replace(self.options, upper=task.bound(self.options.upper) if start.matter.single else 0.0)
        steps = self.options.coarse_steps if self.coarse else self.options.steps
        how = replace(options, steps=steps)
        return voxel_fit(task.scan, start, how, task.seed, task.uneven, lower=task.prior.lower)


def voxel_fit(
    scan: Scan,
    start: VoxelGrid,
    options: VoxelFit,
    seed: int = 0,
    light: Light | None = None,
    *,
    lower: float = 0.0,
) -> Fit:
    """The fit of `start`, on its own grid, to the training frames of `scan`, made ready.

    Minimised is `mean over views of the misfit + λ/(k² V) Σ |∇u|`, k voxels a pixel and V views, so that λ does not
    depend on either. lower: bound of the values from below.
    """
    refine = max(1, round(scan.views.finest / start.grid.voxel_size[0]))
    schedule = replace(options.schedule, steps=options.steps)
    base = ground(scan, start, start.matter, options.objective, schedule, "cpu", finer=refine, light=light)
    weight = base.in_noise(options.weight, options.noise_weight) / (refine**2 * len(base.train))
    scale = torch.tensor([1.0, ABSORPTION_REACH][: len(start.matter)])[:, None, None, None]
    upper = options.upper if options.upper and start.matter.single else float("inf")

    def optimiser(leaves: Leaves) -> ProjectedGradient:
        return ProjectedGradient(leaves, upper, scale, lower)

    terms = (base.frames, VoxelVariation(weight, options.smoothing), *base.extra(options.terms))
    plan = Plan(Problem(base.model, terms), schedule, optimiser, judge=base.judge)
    return Fit(plan, seed)


def refinement(train: Scan, options: VoxelFit) -> int:
    """Voxels along a pixel's edge."""
    height, width = train.views.shape
    refine = options.refine or fringe_sampling(train.exposures)
    while refine > 1 and height * width**2 * refine**3 > options.max_voxels:
        refine -= 1
    return refine
