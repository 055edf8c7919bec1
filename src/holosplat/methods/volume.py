"""A smooth volume: continuous matter without levels, fitted through the waves in units of the noise; and by it the
level of matter with sharp edges of which only the ratio δ/β is known."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated, ClassVar

import torch

from ..backends import Backend, device
from ..baselines import HolographicTV, holographic_tv
from ..baselines.beyond import margins_of
from ..baselines.material import DEFAULT, MaterialEstimate, level_of
from ..checks import require
from ..fit.smooth_volume import ContinuousPrior
from ..frames import evenly
from ..geometry import Grid
from ..matter import DeltaBeta, KnownRatio, Matter, MatterKind
from ..optics.retrieval.spectra import contrast_level
from ..ranges import LARGEST, Natural, Signed, Weight, Within, checked_dataclass
from ..representations import Stored, VoxelGrid
from ..scan import Scan
from .cross_validation import assumed_material, predicted_frames
from .method import Method, Stage, Task, first_of_task, one_material
from .smooth_fit import SmoothFit, SmoothPlan
from .spherical import SphericalFit

LEFT = 0.1
"""Part of the contrast that counts as noise at least where matter leaves the frames: what is beyond explains too much.
Frames that must be explained to less lead to matter half too much or too little before what is expected of it counts
(benchmarks/cut_frames.py)."""


def _start() -> HolographicTV:
    return HolographicTV(noisy=1.0, refine=1, upper=0.0)


@checked_dataclass
class SmoothVolume(Method):
    """Continuous matter on voxels: any value from zero up, no levels, no bound, as likely as frames and noise make it.

    Of matter on both sides of its medium, values below zero as well.

    Where the frames are of one material's ratio δ/β (known, or estimated where nothing is known), δ is free in every
    voxel. `volume` is the start, whose bound is never used.
    """

    kind: ClassVar[str] = "volume"
    kinds_of_matter: ClassVar[tuple[MatterKind, ...]] = ("continuous",)
    cones: ClassVar[bool] = True
    likelier: ClassVar[bool] = True
    two_sided: ClassVar[bool] = True
    several: ClassVar[bool] = True

    volume: HolographicTV = field(default_factory=_start)
    """The start: phase retrieval, total variation, and agreement with the frames. With fewer rounds of agreement than
    `settling` it would end in the middle of them, on matter 1.5 times as wrong."""
    estimate: MaterialEstimate = field(default_factory=MaterialEstimate)
    """How a ratio δ/β that is not known is estimated."""
    prior: ContinuousPrior = field(default_factory=ContinuousPrior)
    """What is expected of continuous matter."""
    coarser: tuple[int, ...] = (4, 2)
    """Edges of the larger voxels [pixels] on which the fit is begun: low frequencies are found there soonest."""
    faint: Weight = 0.3
    """Level of the even matter with which the fit begins on the largest voxels, as a share of the start's; 0: with the
    start. What a start takes of noise and light for matter would stay (benchmarks/beginnings.py); of far less the prior
    leaves nothing."""
    loose: Annotated[float, Within(1, LARGEST)] = 10.0
    """How many times that is the level of the prior in the first round. One for matter so faint would wipe it out; on
    large voxels frames hardly need a prior."""
    rounds: int = 3
    """How often a fit is followed by the modulations that undo what the prior takes."""
    iterations: int = 20
    """Iterations of a round."""
    max_voxels: Natural = 20_000_000
    """Frames are binned rather than having more voxels than this."""
    known_total: tuple[Signed, ...] = ()
    """Total δ of spherical matter, and the standard error of that [m³], where something else than frames tells them,
    as the other times of a series do; empty: nothing does."""

    def __post_init__(self) -> None:
        sizes = all(factor >= 2 for factor in self.coarser) and list(self.coarser) == sorted(self.coarser, reverse=True)
        known = len(self.known_total) in (0, 2) and all(error > 0 for error in self.known_total[1:])
        said = f"known_total must be a total and its positive standard error, or empty, but it is {self.known_total}."
        require(known, said)
        require(sizes, f"coarser must be whole numbers from 2 on, the largest first, but it is {self.coarser}.")

    def stages(self) -> tuple[Stage, ...]:
        """One: the start, and the fit."""
        return (SmoothStage(self),)

    def on_backend(self, backend: Backend) -> SmoothVolume:
        """The same method computed by `backend`."""
        return replace(self, volume=replace(self.volume, backend=backend))

    def with_effort(self, effort: float) -> SmoothVolume:
        """The same method with `effort` times the iterations, at least one."""
        return replace(self, iterations=max(1, round(effort * self.iterations)))


@dataclass(frozen=True)
class SmoothStage:
    """The start and the fit of a smooth volume."""

    options: SmoothVolume
    name: str = "smooth volume"

    def start(self, task: Task, before: Stored | None) -> VoxelGrid:
        """A first volume: δ in units of the known material's, or of the estimated one's."""
        options = self.options
        factor = binning(task.scan, options.max_voxels)
        known, scan = task.unlike_null, task.scan.binned(factor)
        light = known and known.part(torch.arange(len(task.scan)), factor)
        backend = options.volume.backend
        material = assumed_material(scan, one_material(task), task.on_progress, backend, options.estimate)
        beyond = options.volume.beyond and not task.prior.spherical  # which lies in the frames
        how = replace(options.volume, upper=0.0, two_sided=task.prior.two_sided, beyond=beyond)
        lines = task.lines(scan, material, how)
        first, grid = holographic_tv(scan, material, how, task.on_progress, light, lines=lines)
        field = scan.views.padded(margins_of(grid, scan.views))
        return VoxelGrid(first[None], grid, Matter.one(*material)).resampled(Grid.of_views(field))

    def fit(self, task: Task, start: Stored) -> SmoothFit | SphericalFit:
        """The fit to the training frames, from larger voxels on."""
        plan, known_total = self.plan(task, start), self.options.known_total
        if task.prior.spherical:
            return SphericalFit(plan.frames(1), plan.begun, plan.backend, task.prior.lower, known_total)
        require(not known_total, "known_total is of spherical matter, but the matter is of any shape; leave it.")
        return SmoothFit(plan)

    def plan(self, task: Task, start: Stored) -> SmoothPlan:
        """What is fitted to, and how."""
        assert isinstance(start, VoxelGrid)
        options, factor = self.options, binning(task.scan, self.options.max_voxels)
        noise, backend = task.noise.binned(factor), options.volume.backend
        scan = _beside(task, start).binned(factor)
        light = task.uneven and task.uneven.part(torch.arange(len(scan)), factor)
        if any(margins_of(start.grid, scan.views)):
            least = LEFT * contrast_level(scan.measured)
            noise, light = noise.at_least(least), light and replace(light, noise=light.noise.at_least(least))
        two_sided = task.prior.two_sided
        prior = replace(options.prior, two_sided=two_sided)
        faint = 0.0 if two_sided else options.faint  # even matter in a medium is the medium
        how = (prior, options.coarser, options.rounds, options.iterations, faint, options.loose)
        # one density as a level lost 4 % of the total of balls at 500 photons a pixel, and gained nothing
        known = task.prior.materials if len(task.prior.materials) > 1 else ()
        return SmoothPlan(scan, start, noise, task.prior.fixes_ratio, light, *how, backend, known)


def unexplained(task: Task, found: Stored, options: SmoothVolume) -> float:
    """χ² a pixel that a volume leaves of the training frames of a task, in units of their noise and of what is not
    known of their light."""
    fit = SmoothFit(SmoothStage(options).plan(task, found))
    u = fit.voxels.values[0].to(device(fit.backend))
    return fit.problem(1, u, level=1.0).unexplained(u)


def _beside(task: Task, start: VoxelGrid) -> Scan:
    """The frames in the light that they have beside `start`, where that explains them better."""
    if task.uneven is None or task.uneven.background is None:
        return task.scan
    light, measured = task.uneven, (torch.from_numpy(task.scan.frames) * task.uneven.factor()).float()
    predicted, known = predicted_frames(task.scan.exposures, start), task.scan.known(measured)
    after = light.settled(known, predicted)
    better = after.misfit(known, predicted) < light.misfit(known, predicted)
    return replace(task.scan, frames=after.evened(measured).numpy()) if better else task.scan


def binning(scan: Scan, most: int) -> int:
    """How many pixels along an edge are joined, so that voxels of their size are at most `most`; at most all rows."""
    h, w = scan.views.shape
    factor = 1
    while w * w * h / factor**3 > most and factor < min(h, w):
        factor += 1
    return factor


STAGE = "level of the matter"
EDGE, VIEWS = 96, 12
"""Voxels along an edge of the volume whose level is taken, at most, and views of so many voxels: that takes some ten
seconds on one core. A smaller volume is fitted to as many more views, evenly chosen, as take no longer."""


def material_of_levels(task: Task, backend: Backend = "auto", options: MaterialEstimate = DEFAULT) -> DeltaBeta:
    """The `assumed_material` of a task; where a level bounds its matter and has to be found, that of the likeliest
    volume.

    Tomography takes noise off its volume, and with it a tenth to a third of the level in noise of a fifth of the
    contrast, and a third to a half in noise of half of it. The likeliest volume under noise and prior
    (`SmoothVolume`, of at most `EDGE`³ voxels) keeps it, for its prior hardly shrinks what is large
    (docs/data/level.csv); begun with even matter, it would give small balls in noise as strong as the contrast half of
    it. Where that volume is empty, or its level lower, the material is that of tomography: larger voxels than thin
    shells dilute them.
    """
    prior = task.prior
    if not (task.bounded and isinstance(prior, KnownRatio)):
        return assumed_material(task.scan, one_material(task), task.on_progress, backend, options)

    def found() -> DeltaBeta:
        material = assumed_material(task.scan, prior, task.on_progress, backend, options)
        delta = max(material.delta, level_in(task.likeliest or _likeliest(task, options)), key=abs)
        return DeltaBeta(delta, delta / prior.ratio)

    return first_of_task(task).once(("material of levels", prior, backend, options), 0, found)


def _likeliest(task: Task, options: MaterialEstimate) -> VoxelGrid:
    task.on_progress(STAGE, 0.0)
    few = in_few_views(task)
    stage = SmoothStage(SmoothVolume(estimate=options, max_voxels=EDGE**3, rounds=1, faint=0.0))
    fit = stage.fit(few, stage.start(few, None))
    fit.run(lambda record: task.on_progress(STAGE, fit.share))
    return fit.voxels


def level_in(volume: VoxelGrid) -> float:
    """δ of the level of a volume of one channel; 0 of an empty one."""
    values = volume.values[0]
    return level_of(values) * volume.matter.channels[0].delta if bool((values > 0).any()) else 0.0


def in_few_views(task: Task) -> Task:
    """The task with views, evenly chosen, so few that views times voxels are those of `VIEWS` of EDGE³ at most."""
    rows, columns = task.scan.views.shape
    most = VIEWS * EDGE**3 // min(rows * columns**2, EDGE**3)
    if len(task.scan) <= most:
        return task
    return task.of_views(evenly(len(task.scan), most))
