"""Canonical voxels that a network displaces (after D-NeRF), fitted through the waves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import torch
from torch import Tensor

from holosplat.baselines import HolographicTV, holographic_tv
from holosplat.fit.loop import Fit
from holosplat.matter import Matter
from holosplat.methods.assumed import assumed_material
from holosplat.methods.method import Method, Stage, Task, quiet
from holosplat.ranges import Rate, Weight, ranged
from holosplat.representations import Stored, VoxelGrid

from .deformed_voxels import Deformation, DeformedVoxels
from .each_time import require_times, usual_start
from .through_waves import TimesFit, times_fit
from .times import Cost, DrawnTimes


def _fit() -> TimesFit:
    return TimesFit(drawn=DrawnTimes(opening=0.6))


@dataclass(frozen=True)
@ranged
class Deformed(Method):
    """Options of canonical matter and its deformation."""

    kind: ClassVar[str] = "deformed"
    of_series: ClassVar[bool] = True
    likelier: ClassVar[bool] = True

    volume: HolographicTV = field(default_factory=usual_start)
    """The start: the time in the middle by itself."""
    deformation: Deformation = field(default_factory=Deformation)
    """The network and the canonical voxels."""
    rate: Rate = 0.02
    """Adam's first rate of the canonical occupancies."""
    network_rate: Rate = 0.002
    """The same of the network (0.0005 as published, for a thousand times the steps)."""
    strain: Weight = 0.001
    """Weight of ∫ |∇d|² [voxel edges³] of the displacement d at a time."""
    fit: TimesFit = field(default_factory=_fit)
    """The fit through the waves. Times are added from the middle on: matter that moves by more than its size from
    where a network believes it tells it nothing."""

    def stages(self) -> Sequence[Stage]:
        """One."""
        return (DeformedStage(self),)


@dataclass(frozen=True)
class DeformedStage:
    """The matter of the time in the middle, and the fit of all times."""

    options: Deformed
    name: str = "deformed voxels through the waves"

    def start(self, task: Task, before: Stored | None) -> DeformedVoxels:
        """The matter of the time in the middle at all times; `InputError` for a scan of one time."""
        times, options = require_times(task.scan), self.options
        middle = task.scan.at_instant(len(times) // 2)
        material = assumed_material(middle, task.prior, task.on_progress, options.volume.backend)
        bound = task.bound(1.0)
        values, grid = holographic_tv(middle, material, replace(options.volume, upper=bound), quiet)
        matter = Matter.one(*material)
        return DeformedVoxels.still(values, grid, times, matter, bound, options.deformation, task.seed)

    def fit(self, task: Task, start: Stored) -> Fit:
        """The fit to the training frames."""
        options = self.options

        def costs(views: float) -> Sequence[Cost]:
            return [Strain(options.strain / views, options.deformation.cell_px)]

        def rate(name: str) -> float:
            return options.rate if name == "canonical" else options.network_rate

        return times_fit(task, start, options.fit, rate, costs)


class Strain:
    """∫ |∇d|² [voxel edges³] of the displacements of `DeformedVoxels`, mean over times."""

    name = "strain"

    def __init__(self, weight: float, cell: float) -> None:
        """cell: distance of the places at which the network is asked [voxel edges]."""
        self.weight, self._cell = weight, cell

    def __call__(self, moving: Any, seen: Sequence[tuple[float, VoxelGrid]]) -> Tensor:
        """At the times that a step looks at."""
        found = list[Tensor]()
        for time, _ in seen:
            d = moving.displacements(time)
            found += [d.diff(dim=axis).square().sum() for axis in (1, 2, 3) if d.shape[axis] > 1]
        if not found:
            return moving.canonical.new_zeros(())
        return self._cell * torch.stack(found).sum() / len(seen)
