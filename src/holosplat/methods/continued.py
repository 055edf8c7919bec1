"""A fit that goes on from the result of another run: the same matter a little later, or the same frames once more."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import ClassVar

from ..checks import InputError, require
from ..fit.run import Running
from ..inference import Compared, Score
from ..io.objects import read_object
from ..ranges import Natural, Positive, checked_dataclass
from ..representations import GaussianCloud, Stored, SurfaceMesh, VoxelGrid
from .auto import Auto
from .cross_validation import predicted_frames
from .gaussians import Gaussians, GaussianStage
from .method import Method, Stage, Task
from .surface_fit import SurfaceOptions
from .surfaces import Surfaces, SurfaceStage
from .volume import SmoothStage, SmoothVolume


@checked_dataclass
class Effort:
    """How long a fit that goes on takes: matter has moved by a pixel or less, and is else as it was."""

    rounds: Natural = 2
    """Rounds at most; another follows where the last one explains the frames better by the policy of `Compared`. Where
    the last one still does, matter has changed by more than that."""
    surfaces: Natural = 20
    """Steps of surfaces in a round, which take 100 from a start of Gaussians."""
    gaussians: Natural = 30
    """Steps of Gaussians in a round."""
    faster: Positive = 4.0
    """Factor of the rate of their centres: at the usual one they go a third of a pixel in so many steps."""
    volume: Natural = 8
    """Iterations of a smooth volume on voxels of a pixel in a round."""


@dataclass(frozen=True)
class Continued(Method):
    """The object of another run, fitted to these frames with few steps; no phase retrieval, no tomography."""

    kind: ClassVar[str] = "continued"
    """It was decided by the run that it goes on from."""
    two_sided: ClassVar[bool] = True
    several: ClassVar[bool] = True

    begin: Path
    """The object file that it begins with (object.h5)."""
    gaussians: Gaussians = field(default_factory=Gaussians)
    surfaces: SurfaceOptions = field(default_factory=SurfaceOptions)
    volume: SmoothVolume = field(default_factory=SmoothVolume)
    effort: Effort = field(default_factory=Effort)

    @classmethod
    def of(cls, method: Method, begin: Path, effort: Effort = Effort()) -> Continued:
        """What goes on in the way of `method`; `InputError` for one whose fits begin with nothing else than frames."""
        if isinstance(method, Auto):
            return cls(begin, method.gaussians, method.surfaces, method.volume, effort)
        if isinstance(method, Surfaces):
            return cls(begin, method.gaussians, SurfaceOptions(method.extraction, method.fit), effort=effort)
        if isinstance(method, Gaussians):
            return cls(begin, method, effort=effort)
        if isinstance(method, SmoothVolume):
            return cls(begin, volume=method, effort=effort)
        raise InputError(
            f"runs of auto, gaussians, surfaces and volume can be gone on from, but the method is {method.kind}; "
            "choose one of these."
        )

    def afresh(self, found: Stored) -> Method:
        """What makes an object of the kind of `found` from frames alone."""
        return self.volume if isinstance(found, VoxelGrid) else Auto(self.gaussians, self.surfaces)

    @property
    def wants_levels(self) -> bool:
        """It does not matter."""
        return False

    def stages(self) -> Sequence[Stage]:
        """What the other run found, and rounds of its fit."""
        left = list[Score]()
        names = ("fit from before", *(f"round {n} of the fit" for n in range(2, self.effort.rounds + 1)))
        return tuple(ContinuedStage(self, name, left) for name in names)


@dataclass(frozen=True)
class ContinuedStage:
    """A round of the fit of what another run found. left: what states before the rounds leave of the frames, shared by
    all rounds."""

    options: Continued
    name: str
    left: list[Score]

    def start(self, task: Task, before: Stored | None) -> Stored:
        """The object of the other run, or of the round before. Errors: `InputError` for another field or kind."""
        if before is not None:
            return before
        found = read_object(self.options.begin)
        require(
            isinstance(found, SurfaceMesh | GaussianCloud | VoxelGrid),
            f"{self.options.begin} must hold surfaces, Gaussians or voxels to go on from, but it holds {found.kind}; "
            "start without it.",
        )
        return found

    def fit(self, task: Task, start: Stored) -> Running | None:
        """The fit to the training frames, of few steps; None where the round before was of no use."""
        self.left.append(Score.of(task.scan.left(predicted_frames(task.scan.exposures, start))))
        gains = [Compared(self.name, *after.gain_over(before)).wins for before, after in pairwise(self.left)]
        if not all(gains):
            return None
        options, effort = self.options, self.options.effort
        if isinstance(start, SurfaceMesh):
            fit = options.surfaces.fit
            fewer = replace(fit, schedule=replace(fit.schedule, steps=effort.surfaces))
            return SurfaceStage(replace(options.surfaces, fit=fewer)).fit(task, start)
        if isinstance(start, GaussianCloud):
            fit = options.gaussians.fit
            rates = replace(fit.rates, centres=effort.faster * fit.rates.centres)
            fewer = replace(fit, schedule=replace(fit.schedule, steps=effort.gaussians), rates=rates)
            return GaussianStage(replace(options.gaussians, fit=fewer)).fit(task, start)
        short = replace(options.volume, coarser=(), rounds=1, iterations=effort.volume)
        return SmoothStage(short).fit(task, start)
