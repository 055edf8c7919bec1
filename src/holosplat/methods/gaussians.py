"""Gaussians through the waves: the method that `reconstruct` takes by default."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np
import torch

from ..backends import resolve
from ..baselines.beyond import margins_of
from ..fit.density import DensityEvent
from ..fit.loop import Fit, Plan
from ..fit.optimiser import Adam
from ..fit.pose_refinement import PoseRefinement, with_pose_refinement
from ..fit.problem import Problem, Term, block_shape
from ..fit.residuals import set_aside, split_validation
from ..fit.terms import Anisotropy, VolumeTerm
from ..geometry import Grid
from ..matter import Matter
from ..optics.background import Light
from ..optics.noise import noise_share
from ..ranges import checked_dataclass
from ..representations import GaussianCloud, Stored, SurfaceMesh
from ..scan import Scan
from .coarse import STAGE as COARSE
from .coarse import CoarseToFine, Way, coarse_surfaces, last_steps
from .first_surfaces import first_surfaces
from .gaussian_options import FitOptions, GaussianOptions, GaussianRates
from .ground import Ground, ground
from .learned import guessed_start, ways_of_guess
from .method import Method, Near, Stage, Task, run_quietly
from .start import cloud_of_surfaces, starting_cloud
from .surface_fit import SurfaceFit, SurfaceOptions, field_of, oversampling


@checked_dataclass
class Gaussians(GaussianOptions, Method):
    """The method that fits Gaussians to the frames; they start from phase retrieval and tomography, or at random.

    Examples:

        >>> import holosplat as hs
        >>> water = hs.materials.parse_material("water").delta_beta(20.0)
        >>> views = hs.Views.evenly_spaced(8, shape=(16, 16), pixel_size=1e-6)
        >>> cells = hs.specimens.random_cells(1, box=(16e-6, 16e-6, 16e-6), seed=1)
        >>> scene = hs.MeshScene.of_one_material(cells, water)
        >>> scan = hs.simulate(scene, hs.Exposures.of(views, energy_kev=20.0, distance=0.05))
        >>> quick = hs.Gaussians().with_effort(0.1)  # a tenth of the steps
        >>> result = hs.reconstruct(scan, hs.MaterialPrior.known(water), quick)
        >>> type(result.object).__name__
        'GaussianCloud'
    """

    kind: ClassVar[str] = "gaussians"
    cones: ClassVar[bool] = True
    any_backend: ClassVar[bool] = True
    two_sided: ClassVar[bool] = True
    several: ClassVar[bool] = True

    def stages(self) -> tuple[Stage, ...]:
        """One: the start, and the fit."""
        return (GaussianStage(self),)

    def require_files(self) -> None:
        """Read the network's weights where one is asked; errors: those of `LearnedStart.network`."""
        if self.start == "learned":
            _ = self.learned.network

    @property
    def wants_levels(self) -> bool:
        """Whether it matters to these options whether matter has levels."""
        weights = self.fit.objective
        return self.start != "random" or weights.overfull > 0 or weights.two_levels > 0

    def with_effort(self, effort: float) -> Gaussians:
        """The same method with `effort` times the steps, at least one."""
        first, schedule = max(1, round(effort * self.approximate_steps)), self.fit.schedule.with_effort(effort)
        coarse, fit = self.coarse.with_effort(effort), replace(self.fit, schedule=schedule)
        return replace(self, approximate_steps=first, fit=fit, coarse=coarse)


@dataclass(frozen=True)
class GaussianStage:
    """The start and the fit of `Gaussians`."""

    options: Gaussians
    name: str = "fit"
    poor: list[tuple[Scan, SurfaceMesh | None]] = field(default_factory=list, compare=False, repr=False)
    """The frames and what `near_surfaces` gave up last, as it explained them badly; None where there was nothing."""

    def start(self, task: Task, before: Stored | None) -> Stored | Near:
        """What the fit begins with; of small frames where a network is asked, what it is without one, or its guess."""
        if self.options.start == "learned" and self._small(task):
            return self._or_guess(task, replace(self, options=self._without_network).start(task, before))
        return self._start(task)

    def _start(self, task: Task) -> Stored | Near:
        """The starting cloud: of surfaces on coarse pixels, or its own."""
        how = SurfaceOptions(fit=SurfaceFit(backend=self.options.fit.backend))
        surfaces = self.coarse_surfaces(task, how)
        if surfaces is None:
            return self.own_start(task)
        return self.near(task, last_steps(self._without_validation(task), surfaces, how, self.options.coarse))

    def near(self, task: Task, surfaces: SurfaceMesh) -> Near:
        """What is begun with where `surfaces` of the frames of `task` are known: the Gaussians that fill them."""
        return Near(cloud_of_surfaces(surfaces, task).on(resolve(self.options.volume.backend)))

    def own_start(self, task: Task) -> Stored | Near:
        """The starting cloud on the pixels of `task`."""
        plain = starting_cloud(self._without_validation(task), self._without_network)
        return self._or_guess(task, plain) if self.options.start == "learned" else plain

    def _or_guess(self, task: Task, plain: Stored | Near) -> Stored | Near:
        """What is begun with of the network's guess, else what is begun with without it."""
        start = plain.object if isinstance(plain, Near) else plain
        assert isinstance(start, GaussianCloud | SurfaceMesh)
        seen = self._without_validation(task)
        guess = guessed_start(seen, self.options, self._fitted, lambda: start)
        if isinstance(guess, SurfaceMesh):
            return self.near(task, guess)
        return plain if guess is None else guess

    @property
    def _without_network(self) -> Gaussians:
        """The same options where no network is asked."""
        return replace(self.options, start="phase") if self.options.start == "learned" else self.options

    def _small(self, task: Task) -> bool:
        """Whether its frames begin on their own pixels."""
        return self.options.coarse.factor(task.scan.views.shape) == 1

    def _without_validation(self, task: Task) -> Task:
        """`task` without the frames that validate its fit."""
        count = self.options.fit.schedule.validation_views
        if count == 0:
            return task
        train, _ = split_validation(task.scan, count)
        left = torch.from_numpy(np.flatnonzero(~set_aside(len(task.scan), count)))
        return replace(task, scan=train, lit=None if task.lit is None else task.lit.part(left))

    def _fitted(self, task: Task, cloud: GaussianCloud, steps: int) -> GaussianCloud:
        """`cloud` after so many steps, on the frames of `task` alone."""
        fit, schedule = self.options.fit, self.options.fit.schedule
        short = replace(fit, schedule=replace(schedule, steps=min(steps, schedule.steps), validation_views=0))
        run = GaussianStage(replace(self.options, fit=short)).fit(replace(task, near=False, freedom=None), cloud)
        return run_quietly(run, task.report(self.name), GaussianCloud)

    def fit(self, task: Task, start: Stored) -> Fit:
        """The fit of the cloud to the training frames."""
        assert isinstance(start, GaussianCloud)
        options = resolved(self.options.fit, task, start.matter)
        if task.near:
            options = nearby(options, self.options.coarse, oversampling(task.scan))
        return gaussian_fit(task.scan, start, options, task.seed, task.uneven, task.freedom)

    def coarse_surfaces(self, task: Task, surfaces: SurfaceOptions) -> SurfaceMesh | None:
        """Surfaces near to those of the frames, where these are large and coarse pixels show the bodies."""
        return None if self._small(task) else self.near_surfaces(task, surfaces)

    def near_surfaces(self, task: Task, surfaces: SurfaceOptions) -> SurfaceMesh | None:
        """The same of frames of any size."""
        how, options = self.options.coarse, self.options
        if how.columns == 0 or options.start == "random" or not task.bounded:
            return None

        plain = replace(self, options=self._without_network)

        def first(coarse: Task) -> Sequence[Way]:
            ways = first_surfaces(coarse, plain.options, surfaces, plain.solved)
            if options.start == "phase":
                return ways
            return ways_of_guess(coarse, ways, options, surfaces, self._fitted)

        found, poor = coarse_surfaces(self._without_validation(task), first, surfaces, how)
        self.poor[:] = [(task.scan, poor)]
        return found

    def solved(self, task: Task) -> GaussianCloud:
        """The cloud fitted to the frames of `task`."""
        start = self.own_start(task)
        assert isinstance(start, GaussianCloud)
        return run_quietly(self.fit(task, start), task.report(f"{COARSE}: Gaussians"), GaussianCloud)


def resolved(options: FitOptions, task: Task, matter: Matter) -> FitOptions:
    """The options without what bounds the occupancy where nothing says what an occupancy of one is."""
    if task.bounded or (task.matter == "levels" and bool(matter.others)):
        return options
    return replace(options, objective=replace(options.objective, overfull=0.0, two_levels=0.0))


def nearby(options: FitOptions, how: CoarseToFine, samples: int) -> FitOptions:
    """The options of a fit that begins near to where it ends, with edges as sharp as those of surfaces: fewer and
    shorter steps, and waves of so many samples a pixel, if the options do not say how many."""
    rates = GaussianRates(**{name: how.fit_rate * rate for name, rate in vars(options.rates).items()})
    schedule = replace(options.schedule, steps=how.fit_steps, oversample=options.schedule.oversample or samples)
    return replace(options, rates=rates, schedule=schedule)


def gaussian_fit(
    scan: Scan,
    cloud: GaussianCloud,
    options: FitOptions,
    seed: int = 0,
    light: Light | None = None,
    freedom: PoseRefinement | None = None,
) -> Fit:
    """The fit of `cloud` to the training frames of `scan` in uneven `light`, made ready; errors: those of `ground`.

    freedom: of where these frames are, which is then fitted, too.
    """
    plan, train = gaussian_plan(scan, cloud, options, light)
    return Fit(with_pose_refinement(plan, freedom, train), seed)


def gaussian_plan(
    scan: Scan, cloud: GaussianCloud, options: FitOptions, light: Light | None = None
) -> tuple[Plan, Scan]:
    """What `gaussian_fit` does, and the frames that it fits."""
    backend, schedule = resolve(options.backend), options.schedule
    base = ground(scan, cloud.on(backend), cloud.matter, options.objective, schedule, backend, light=light)
    grid = Grid.of_views(field_of(cloud, scan.views))
    terms = [base.frames, *_object_terms(base, options, grid, cloud.matter), *base.extra(options.terms)]
    plan = Plan(
        problem=Problem(base.model, tuple(terms)),
        schedule=schedule,
        optimiser=lambda leaves: Adam(leaves, backend),
        rates=lambda factor, step: options.rates.at(factor, step >= schedule.warmup_steps),
        events=(DensityEvent(options.density, base.train.views.padded(margins_of(grid, scan.views))),),
        judge=base.judge,
        grid=grid if options.objective.uses_volume else None,
    )
    return plan, base.train


def _object_terms(base: Ground, options: FitOptions, grid: Grid, matter: Matter) -> list[Term]:
    w, terms = options.objective, list[Term]()
    if w.anisotropy > 0:
        terms.append(Anisotropy(w.anisotropy, w.anisotropy_limit))
    if w.uses_volume:
        block = grid.block((0, 0, 0), block_shape(grid, options.schedule))
        noise = noise_share(base.train.measured)
        depth = grid.shape[0] * grid.shape[1] / Grid.of_views(base.train.views).shape[1]
        terms.append(VolumeTerm(w, block, depth, len(base.train), noise, matter.occupancies))
    return terms
