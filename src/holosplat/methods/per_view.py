"""Phase retrieval of each view by itself, then tomography: what others do."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import torch

from ..baselines import TOMOGRAPHIES, Tomography
from ..checks import InputError
from ..geometry import Grid
from ..matter import Matter
from ..optics.retrieval import RETRIEVALS
from ..representations import Stored, VoxelGrid
from .cross_validation import assumed_material
from .method import Method, Stage, Task, one_material


@dataclass(frozen=True)
class PerView(Method):
    """Phase retrieval of each view, then tomography, on voxels of one pixel; the occupancy of one material."""

    kind: ClassVar[str] = "per-view"
    cones: ClassVar[bool] = True
    two_sided: ClassVar[bool] = True
    tomographies: ClassVar[Mapping[str, Tomography]] = TOMOGRAPHIES
    """Name → tomography, of those to choose from; other packages' classes may have their own."""

    retrieval: str = "tikhonov"
    """Name of the phase retrieval."""
    tomography: str = "tv"
    """Name of the tomography."""
    bounded: bool = True
    """Whether the occupancy is kept below one where the material is known."""

    def __post_init__(self) -> None:
        for name, value, choices in (
            ("retrieval", self.retrieval, RETRIEVALS),
            ("tomography", self.tomography, self.tomographies),
        ):
            if value not in choices:
                raise InputError(f"{name} must be one of {', '.join(choices)}, but it is {value!r}.")

    def stages(self) -> tuple[Stage, ...]:
        """One, without a fit."""
        return (PerViewStage(self),)


@dataclass(frozen=True)
class PerViewStage:
    """Retrieval and tomography."""

    options: PerView
    name: str = "tomography"

    def start(self, task: Task, before: Stored | None) -> VoxelGrid:
        """Occupancies of the known material, or of the one that the frames suggest."""
        scan, how = task.scan, self.options
        material = assumed_material(scan, one_material(task), task.on_progress)
        retrieve = RETRIEVALS[how.retrieval]
        frames = torch.from_numpy(scan.frames)
        report = task.report("phase retrieval")
        known = {"missing": scan.gaps, "two_sided": task.prior.two_sided}
        thickness = retrieve(frames, scan.exposures, *material, on_progress=report, **known)
        grid, report = Grid.of_views(scan.views), task.report(self.name)
        upper = (task.bound(1.0) or None) if how.bounded else None
        values = how.tomographies[how.tomography](thickness, scan.views, grid, upper, report, **known)
        return VoxelGrid(values[None], grid, Matter.one(*material))

    def fit(self, task: Task, start: Stored) -> None:
        """Nothing is fitted."""
