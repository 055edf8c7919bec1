"""The method that `reconstruct` takes by default: Gaussians or surfaces of bodies, or a smooth volume."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import ClassVar

from ..checks import InputError
from ..fit.loop import Fit
from ..matter import MatterKind
from ..ranges import ranged
from ..representations import GaussianCloud, Stored, SurfaceMesh
from .gaussians import Gaussians
from .method import Method, Stage, Task
from .surface_fit import SurfaceOptions
from .surfaces import BodiesStage, SurfaceStage
from .volume import SmoothVolume


@dataclass(frozen=True)
@ranged
class Auto(Method):
    """Matter with levels: Gaussians, and closed surfaces where there are bodies. Continuous matter: a smooth volume."""

    kind: ClassVar[str] = "auto"
    cones: ClassVar[bool] = True
    any_backend: ClassVar[bool] = True
    mixes_kinds: ClassVar[bool] = True
    """A volume may take the place of bodies."""
    two_sided: ClassVar[bool] = True
    several: ClassVar[bool] = True

    gaussians: Gaussians = field(default_factory=Gaussians)
    surfaces: SurfaceOptions = field(default_factory=SurfaceOptions)
    volume: SmoothVolume = field(default_factory=SmoothVolume)

    def stages(self) -> Sequence[Stage]:
        """Those for matter with levels."""
        return self.suited("levels").stages()

    def suited(self, matter: MatterKind) -> Method:
        """What is done with a kind of matter."""
        return self.volume if matter == "continuous" else Bodies(self.gaussians, self.surfaces)

    @property
    def kinds(self) -> Mapping[MatterKind, Method]:
        """The same of either kind."""
        return {"levels": self.suited("levels"), "continuous": self.volume}

    def require_files(self) -> None:
        """Those of the Gaussians."""
        self.gaussians.require_files()

    def with_effort(self, effort: float) -> Auto:
        """The same method with `effort` times the steps, at least one."""
        bodies = Bodies(self.gaussians, self.surfaces).with_effort(effort)
        return Auto(bodies.gaussians, bodies.surfaces, self.volume.with_effort(effort))


@dataclass(frozen=True)
class Bodies(Method):
    """Gaussians, and surfaces where these enclose bodies of one material."""

    kind: ClassVar[str] = "bodies"
    several: ClassVar[bool] = True
    cones: ClassVar[bool] = True
    mixes_kinds: ClassVar[bool] = True

    gaussians: Gaussians
    surfaces: SurfaceOptions

    def stages(self) -> Sequence[Stage]:
        """Those of the Gaussians and the surfaces."""
        bodies = BodiesStage(self.gaussians, surfaces=self.surfaces)
        return (bodies, SurfacesWhereClosed(self.surfaces, self.gaussians.coarse, bodies.best_cut))

    def with_effort(self, effort: float) -> Bodies:
        """The same method with `effort` times the steps, at least one."""
        return Bodies(self.gaussians.with_effort(effort), self.surfaces.with_effort(effort))


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
