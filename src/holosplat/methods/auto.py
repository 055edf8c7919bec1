"""The method that `reconstruct` takes by default: Gaussians or surfaces of bodies, or a smooth volume."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

from ..backends import Backend
from ..checks import InputError
from ..fit.loop import Fit
from ..matter import DeltaBeta, MatterKind
from ..ranges import Share, ranged
from ..representations import GaussianCloud, Stored, SurfaceMesh, VoxelGrid
from .assumed import assumed_material
from .cross_validation import CrossValidation, MissingMatter
from .evidence import Evidence
from .gaussians import Gaussians
from .method import Method, Stage, Task, solve_stages
from .smooth_fit import SmoothFit
from .surface_fit import SurfaceOptions
from .surfaces import BodiesStage, SurfaceStage
from .volume import SmoothStage, SmoothVolume

TRIAL = "trial of methods"
CLEARLY = 0.95
"""Part of what one method leaves unexplained beyond noise that another must stay below, or a trial decides nothing."""


OTHER: Mapping[MatterKind, MatterKind] = {"levels": "continuous", "continuous": "levels"}
KINDS: Mapping[MatterKind, str] = {"levels": Gaussians.kind, "continuous": SmoothVolume.kind}
"""What stands for either kind of matter in a trial."""


@dataclass(frozen=True)
@ranged
class Auto:
    """Matter with levels: Gaussians, and closed surfaces where there are bodies. Continuous matter: a smooth volume."""

    kind: ClassVar[str] = "auto"
    mixes_kinds: ClassVar[bool] = True
    """A volume may take the place of bodies."""

    gaussians: Gaussians = field(default_factory=Gaussians)
    surfaces: SurfaceOptions = field(default_factory=SurfaceOptions)
    volume: SmoothVolume = field(default_factory=SmoothVolume)
    trials: CrossValidation = field(default_factory=CrossValidation)
    """How views are set aside for trials."""
    unexplained: Share = 0.12
    """Share of all matter that bodies may leave unexplained, beyond noise, before a smooth volume is tried. Where it is
    too low, a volume is fitted in vain, for it must leave half of what they do to be taken."""

    def stages(self) -> Sequence[Stage]:
        """Those for matter with levels."""
        return self.suited("levels").stages()

    def suited(self, matter: MatterKind) -> Method:
        """What is done with a kind of matter."""
        return (
            self.volume
            if matter == "continuous"
            else Bodies(self.gaussians, self.surfaces, self.volume, self.unexplained, self.trials)
        )

    def require_files(self) -> None:
        """Those of the Gaussians."""
        self.gaussians.require_files()

    def on_backend(self, backend: Backend) -> Auto:
        """The same method computed by `backend`."""
        return replace(
            self,
            gaussians=self.gaussians.on_backend(backend),
            surfaces=replace(self.surfaces, fit=replace(self.surfaces.fit, backend=backend)),
            volume=self.volume.on_backend(backend),
        )

    def with_effort(self, effort: float) -> Auto:
        """The same method with `effort` times the steps, at least one."""
        schedule = self.surfaces.fit.schedule
        fewer = replace(schedule, steps=max(1, round(effort * schedule.steps)))
        surfaces = replace(self.surfaces, fit=replace(self.surfaces.fit, schedule=fewer))
        return replace(
            self,
            gaussians=self.gaussians.with_effort(effort),
            surfaces=surfaces,
            volume=self.volume.with_effort(effort),
        )


@dataclass(frozen=True)
class Trial:
    """How Gaussians and a smooth volume foretell views that are set aside, on coarse frames.

    shares: of all matter in these that either leaves unexplained; noise: square of the share that is noise
    """

    shares: Mapping[MatterKind, float]
    noise: float

    @classmethod
    def of(cls, task: Task, gaussians: Gaussians, volume: SmoothVolume, how: CrossValidation) -> Trial | None:
        """That of `task`; None where there are too few views to set some aside."""
        split = how.split(task.scan)
        if split is None:
            return None
        seen, aside = split
        judge = MissingMatter(aside, assumed_material(seen, task.prior, task.on_progress))
        shares = dict[MatterKind, float]()
        plain = replace(gaussians, start="phase") if gaussians.start == "learned" else gaussians
        candidates: dict[MatterKind, Method] = {"levels": plain, "continuous": volume}
        for matter, method in candidates.items():
            task.on_progress(f"{TRIAL}: {method.kind}", 0.0)
            trial = replace(task, scan=seen, lit=how.light(task.scan, task.lit), matter=matter)
            shares[matter] = judge.share(solve_stages(method, trial))
        noise = judge.of(how.noise_aside(task.scan, task.noise).drawn(task.seed)) / max(judge.whole, 1e-60)
        return cls(shares, noise)

    @property
    def beyond(self) -> Mapping[MatterKind, float]:
        """Squares of the shares, without that of the noise."""
        return {matter: max(share**2 - self.noise, 0.0) for matter, share in self.shares.items()}

    def clearly(self, matter: MatterKind) -> bool:
        """Whether one kind foretells the views clearly better than the other."""
        beyond = self.beyond
        return beyond[matter] < CLEARLY**2 * beyond[OTHER[matter]]


@dataclass(frozen=True)
class Bodies:
    """Gaussians, surfaces where these enclose bodies of one material; a smooth volume where neither explains much."""

    kind: ClassVar[str] = "bodies"
    mixes_kinds: ClassVar[bool] = True

    gaussians: Gaussians
    surfaces: SurfaceOptions
    volume: SmoothVolume
    unexplained: float
    trials: CrossValidation

    def stages(self) -> Sequence[Stage]:
        """Those of the Gaussians, the surfaces, and the volume."""
        bodies = BodiesStage(self.gaussians, surfaces=self.surfaces)
        closed = SurfacesWhereClosed(self.surfaces, self.gaussians.coarse, bodies.best_cut)
        last = VolumeWhereUnexplained(self.volume, self.unexplained, self.gaussians, self.trials)
        return (bodies, closed, last)


@dataclass(frozen=True)
class SurfacesWhereClosed(SurfaceStage):
    """Surfaces of one material of known level; where there are none, what came before stays as it is."""

    def start(self, task: Task, before: Stored | None) -> Stored:  # type: ignore[override]
        """The surfaces cut out of Gaussians, or these; surfaces as they are."""
        if isinstance(before, SurfaceMesh):
            return before
        assert isinstance(before, GaussianCloud)
        if not (before.matter.single and task.bounded):
            return before
        try:
            return super().start(task, before)
        except InputError:  # no surface anywhere
            return before

    def fit(self, task: Task, start: Stored) -> Fit | None:  # type: ignore[override]
        """The fit of the surfaces; None for Gaussians."""
        return super().fit(task, start) if isinstance(start, SurfaceMesh) else None


@dataclass(frozen=True)
class VolumeWhereUnexplained:
    """A smooth volume, where matter with levels explains the frames badly, and foretells others clearly worse: then
    there are no such levels.

    In few views a volume explains any frames, and says the less of views between them: so it is tried on views that are
    set aside, and not taken where there are too few for that.

    most: share of all matter that what came before may leave unexplained, beyond noise; gaussians, trials: of the trial
    """

    options: SmoothVolume
    most: float
    gaussians: Gaussians
    trials: CrossValidation
    name: str = "smooth volume"
    better: ClassVar[float] = 2.0
    """So many times less must it leave unexplained than bodies do: it is freer, and follows the frames' errors, too."""
    of_best: ClassVar[bool] = True
    """It is the best of the states before it that must explain the frames, not the latest."""

    def start(self, task: Task, before: Stored | None) -> Stored:
        """A first volume; what came before, where that explains the frames or has two materials."""
        assert before is not None
        matter = before.matter
        if not matter.single or task.scan.is_series:
            return before
        judge = MissingMatter(task.scan, DeltaBeta(matter.delta, matter.beta))
        left = Evidence(judge, task.noise).share(judge.predicted(before))
        if left <= self.most or not self._foretells(task):
            return before
        return SmoothStage(self.options).start(_continuous(task), None)

    def _foretells(self, task: Task) -> bool:
        tried = Trial.of(task, self.gaussians, self.options, self.trials)
        return tried is not None and tried.clearly("continuous")

    def fit(self, task: Task, start: Stored) -> SmoothFit | None:
        """The fit of the volume; None for what came before."""
        return SmoothStage(self.options).fit(_continuous(task), start) if isinstance(start, VoxelGrid) else None


def _continuous(task: Task) -> Task:
    return replace(task, matter="continuous")
