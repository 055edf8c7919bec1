"""Closed surfaces: cut out of a reconstruction by Gaussians, and fitted to the same frames."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial
from typing import ClassVar

from ..checks import InputError, require
from ..fit.loop import Fit
from ..inference import LEAST, Score, select
from ..matter import MaterialPrior
from ..progress import Progress
from ..representations import GaussianCloud, Stored, SurfaceMesh
from ..scan import Scan
from .coarse import CoarseToFine, Way, begun_surfaces, coarse_surfaces, in_steps, missing_matter, on_pixels, settled
from .cross_validation import BY_FISSION, MANY, Folds
from .first_surfaces import Cut, cut_as_seen, first_surfaces, is_noisy, surfaces_of_volume, with_missing_bodies
from .gaussians import Gaussians, GaussianStage
from .keeper import BY
from .method import Method, Near, Stage, Task, quiet, run_quietly
from .surface_fit import SurfaceOptions, extract_surfaces, frames_of, surface_fit

STAGE = "surfaces"


@dataclass(frozen=True)
class Surfaces(SurfaceOptions, Method):
    """The method that cuts closed surfaces out of Gaussians, and fits them to the frames.

    Examples:

        >>> import holosplat as hs
        >>> water = hs.materials.parse_material("water").delta_beta(20.0)
        >>> views = hs.Views.evenly_spaced(8, shape=(16, 16), pixel_size=1e-6)
        >>> cells = hs.specimens.random_cells(1, box=(16e-6, 16e-6, 16e-6), seed=1)
        >>> scene = hs.MeshScene.of_one_material(cells, water)
        >>> scan = hs.simulate(scene, hs.Exposures.of(views, energy_kev=20.0, distance=0.05))
        >>> quick = hs.Surfaces().with_effort(0.1)  # a tenth of the steps
        >>> result = hs.reconstruct(scan, hs.MaterialPrior.known(water), quick)
        >>> len(result.object.bodies())
        1
    """

    kind: ClassVar[str] = "surfaces"
    cones: ClassVar[bool] = True
    several: ClassVar[bool] = True
    any_backend: ClassVar[bool] = True

    gaussians: Gaussians = field(default_factory=Gaussians)

    def stages(self) -> Sequence[Stage]:
        """Those of the Gaussians, and the surfaces."""
        bodies = BodiesStage(self.gaussians, surfaces=self)
        return (bodies, SurfaceStage(self, self.gaussians.coarse, bodies.best_cut))

    def require_files(self) -> None:
        """Those of the Gaussians."""
        self.gaussians.require_files()

    def with_effort(self, effort: float) -> Surfaces:
        """The same method with `effort` times the steps, at least one."""
        return replace(super().with_effort(effort), gaussians=self.gaussians.with_effort(effort))


BODIES, AS_FOUND, MORE = "missing bodies", "as found", "with missing bodies"


@dataclass(frozen=True)
class BodiesStage(GaussianStage):
    """What surfaces begin with: those of coarse pixels where these show the bodies, and Gaussians elsewhere."""

    surfaces: SurfaceOptions = field(default_factory=SurfaceOptions)

    def _start(self, task: Task) -> Stored | Near:
        """Surfaces near to the frames', or the starting cloud."""
        found = self.coarse_surfaces(task, self.surfaces)
        return self.own_start(task) if found is None else self.near(task, found)

    def near(self, task: Task, surfaces: SurfaceMesh) -> Near:
        """`surfaces` themselves."""
        return Near(surfaces)

    def coarse_surfaces(self, task: Task, surfaces: SurfaceOptions) -> SurfaceMesh | None:
        """Those of coarse pixels, which small frames have themselves; small noisy ones are for Gaussians, but those of
        several known materials."""
        if len(task.prior.materials) > 1 and self._small(task) and self._straight(task):
            seen, how = self._without_validation(task), self.options.coarse
            return begun_surfaces(
                seen, lambda at: first_surfaces(at, self.options, surfaces, self.solved), surfaces, how
            )
        straight = self._straight(task) and not is_noisy(task, self.options)
        return self.near_surfaces(task, surfaces) if straight or not self._small(task) else None

    def best_cut(self, task: Task, cloud: GaussianCloud, cut: Cut) -> SurfaceMesh:
        """The surfaces that `cut` gets out of `cloud`; or, if they explain more by the policy of `select`, of small
        frames those of a first volume, where there are any, and, where much matter is missing from the first after some
        steps, those cut on finer voxels. Of small frames bodies that are missing join them (`_with_missing_bodies`).

        Marching cubes leave out what is not much thicker than their voxels, and surfaces that are missing do not grow.
        Errors: those of `cut`, where there are no others.
        """
        if not task.bounded or task.freedom is not None:
            return cut(self.surfaces.extraction)
        how, seen, found = self.options.coarse, self._without_validation(task), dict[str, SurfaceMesh]()
        steps, most = how.of_views(len(seen.scan.train())), how.missing_matter
        try:
            first = cut_as_seen(seen, cut, self.surfaces)
        except InputError:  # Gaussians hold no surface
            other = self._of_first_volume(task, None)
            if other is None:
                raise
            return other
        other = self._of_first_volume(task, cloud)
        if other is not None:
            found["of a volume"] = other
        lacking, small = bool(found) or self._missing(first, task) > most, self._small(task) and how.join_missing
        if not (lacking or small):
            return first
        own = settled(seen, first, self.surfaces, steps)
        if lacking:
            if self._missing(own, task) > most:
                finer = replace(self.surfaces, extraction=self.surfaces.extraction.finer())
                found["on finer voxels"] = settled(seen, cut_as_seen(seen, cut, finer), self.surfaces, steps)
            chosen = self._chosen("surfaces", {"of Gaussians": own, **found}, seen)
            if chosen is not own or "of a volume" in found:
                first = own = chosen
        more = self._with_missing_bodies(seen, own, steps) if small else None
        return more or first

    def _chosen(self, name: str, found: Mapping[str, SurfaceMesh], task: Task) -> SurfaceMesh:
        """The surfaces that explain most of the frames by the policy of `select`, the null first."""
        decision = select(name, tuple(found), lambda one, _: self._score(found[one], task), by=BY)
        task.on_start(decision, None)
        return found[decision.choice]

    def _with_missing_bodies(self, task: Task, found: SurfaceMesh, steps: CoarseToFine) -> SurfaceMesh | None:
        """`found` and bodies missing from it, if these explain more of the training frames than as many steps without
        them, and then more of views that are set aside; else None.

        Training frames alone may prefer bodies that make up for noise. In each fold both begin with `found`, which has
        seen all views, and bodies are sought in the others alone. Of few views each shows what the others do not, so
        that fewer find other bodies: noise is split (`Folds`), and as its halves have more of it than the frames, of
        which they have told how much is explained, the gain need only be sure.
        """
        joined = with_missing_bodies(task, found, self.surfaces, steps)
        if joined is None:
            return None
        (level, more), own = joined, settled(task, found, self.surfaces, steps)
        if self._chosen(BODIES, {AS_FOUND: own, MORE: more}, task) is own:
            return None
        folds = Folds.of(task.scan, binning=1, fewest=MANY)

        @cache
        def scores(fold: int) -> dict[str, Score]:
            seen, unseen = folds.split(fold)
            part = replace(task.of_views(folds.kept(fold)), scan=seen)
            null = settled(part, found, self.surfaces, steps)
            _, other = with_missing_bodies(part, found, self.surfaces, steps, (level,)) or (level, null)
            both = {AS_FOUND: null, MORE: other}
            return {name: self._score(each, replace(task, scan=unseen)) for name, each in both.items()}

        least = 0.0 if folds.by == BY_FISSION else LEAST
        both = (AS_FOUND, MORE), lambda name, fold: scores(fold)[name], folds.count
        decision = select(BODIES, *both, by=folds.by, least=least)
        task.on_start(decision, None)
        return more if decision.choice == MORE else None

    def _of_first_volume(self, task: Task, cloud: GaussianCloud | None) -> SurfaceMesh | None:
        """Surfaces without which Gaussians began, as they explain the frames badly; or, where there are none and
        Gaussians lack much matter or hold no surface (`cloud` is None), those that have taken turns with a volume, of
        thin bodies, too. Large frames and Gaussians from a random start have none."""
        how = self.options.coarse
        if not (self._small(task) and self._straight(task)):
            return None
        if not is_noisy(task, self.options):
            if not (self.poor and self.poor[0][0] is task.scan):  # of a run that was resumed
                self.near_surfaces(task, self.surfaces)
            if self.poor[0][1] is not None:
                return self.poor[0][1]
        if cloud is not None and self._missing(cloud, task) <= how.missing_matter:
            return None
        seen = self._without_validation(task)
        return begun_surfaces(seen, lambda at: surfaces_of_volume(at, self.options, self.surfaces), self.surfaces, how)

    def _score(self, found: SurfaceMesh, task: Task) -> Score:
        return Score.of(task.scan.left(frames_of(found, task.scan, self.surfaces.fit).double()))

    def _missing(self, found: SurfaceMesh | GaussianCloud, task: Task) -> float:
        return missing_matter(found, task, self.surfaces)

    def _straight(self, task: Task) -> bool:
        """Whether surfaces of small frames may come before Gaussians."""
        return self.options.start != "random" and task.freedom is None and self.options.coarse.columns > 0

    def fit(self, task: Task, start: Stored) -> Fit | None:  # type: ignore[override]
        """The fit of the cloud; none of surfaces, for the next stage has it."""
        return super().fit(task, start) if isinstance(start, GaussianCloud) else None


@dataclass(frozen=True)
class SurfaceStage:
    """Surfaces from what came before."""

    options: SurfaceOptions
    coarse: CoarseToFine = field(default_factory=CoarseToFine)
    """How few steps a near start takes."""
    choose: Callable[[Task, GaussianCloud, Cut], SurfaceMesh] | None = None
    """What a task begins with, by Gaussians and what cuts surfaces out of them; None: with these."""
    name: str = STAGE

    def start(self, task: Task, before: Stored | None) -> Stored:
        """The surfaces cut out of Gaussians; closed surfaces are taken as they are."""
        if isinstance(before, SurfaceMesh):
            return before
        task.on_progress(f"{STAGE}: extraction", 0.0)
        require(
            isinstance(before, GaussianCloud),
            f"surfaces are cut out of Gaussians, but what came before is {getattr(before, 'kind', before)!r}; "
            "reconstruct with --method gaussians first.",
        )
        assert isinstance(before, GaussianCloud)
        cut = partial(extract_surfaces, before, task.scan)
        return cut(self.options.extraction) if self.choose is None else self.choose(task, before, cut)

    def fit(self, task: Task, start: Stored) -> Fit:
        """The fit of the surfaces to the training frames."""
        assert isinstance(start, SurfaceMesh)
        coarse = self.coarse.of_views(len(task.scan.train()))
        options = in_steps(self.options.fit, coarse.last_steps) if task.near else self.options.fit
        freedom = task.freedom and replace(task.freedom, edges=task.prior.kind == "known")
        return surface_fit(task.scan, start, options, task.seed, task.uneven, freedom)


def refine_surfaces(
    cloud: Stored,
    scan: Scan,
    options: SurfaceOptions = SurfaceOptions(),
    on_progress: Progress = quiet,
    coarse: CoarseToFine | None = None,
) -> SurfaceMesh:
    """Surfaces cut out of `cloud`, or `cloud` itself if it is one, fitted to the training frames of `scan`.

    By the usual options, those of Gaussians in large frames are cut out on coarse pixels where these show the bodies,
    and go from there to finer ones (`coarse_surfaces`), as `coarse` or usually. Errors: of `extract_surfaces` and
    `surface_fit`.
    """
    stage, task = (
        SurfaceStage(options, coarse or CoarseToFine()),
        Task(scan.train(), MaterialPrior.unknown(), 0, on_progress),
    )
    usual = replace(options, fit=replace(options.fit, backend="auto")) == SurfaceOptions()
    start = _by_coarse_pixels(cloud, task, stage) if usual else None
    if start is None:
        start = stage.start(task, cloud)
    else:
        task = replace(task, near=True)
    return run_quietly(stage.fit(task, start), task.report(STAGE), SurfaceMesh)


def _by_coarse_pixels(cloud: Stored, task: Task, stage: SurfaceStage) -> SurfaceMesh | None:
    """Surfaces of `cloud` near to those of large frames; None of small ones, and where coarse pixels show no bodies."""
    if not isinstance(cloud, GaussianCloud) or stage.coarse.factor(task.scan.views.shape) == 1:
        return None

    def first(coarse: Task) -> Sequence[Way]:
        return (lambda before: cut(coarse),)

    def cut(coarse: Task) -> SurfaceMesh:
        found = extract_surfaces(cloud, coarse.scan, stage.options.extraction)
        return on_pixels(found, coarse.scan.views.finest, math.inf)

    return coarse_surfaces(task, first, stage.options, stage.coarse)[0]
