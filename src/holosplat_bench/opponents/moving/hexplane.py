"""A field of six planes of features (HexPlane), fitted through the waves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import torch
from torch import Tensor

from holosplat.fit.loop import Fit
from holosplat.geometry import Grid
from holosplat.matter import Matter
from holosplat.methods.assumed import assumed_material
from holosplat.methods.method import Method, Stage, Task
from holosplat.ranges import Rate, Weight, ranged
from holosplat.representations import Stored, VoxelGrid

from .each_time import require_times
from .hexplane_field import PAIRS, TIME_PLANES, HexPlaneField, HexPlanes
from .through_waves import TimesFit, times_fit
from .times import Cost


@dataclass(frozen=True)
@ranged
class HexPlane(Method):
    """Options of a field of six planes: its start is random, as published."""

    kind: ClassVar[str] = "hexplane"
    of_series: ClassVar[bool] = True
    likelier: ClassVar[bool] = True

    planes: HexPlanes = field(default_factory=HexPlanes)
    """The planes and the decoder."""
    rate: Rate = 0.1
    """Adam's first rate of the planes (0.02 as published, for a hundred times the steps)."""
    decoder_rate: Rate = 0.02
    """The same of the decoder (0.001 as published)."""
    roughness: Weight = 1e-4
    """Weight of squared differences of features between nodes of a plane in space, their mean times the voxels."""
    jerkiness: Weight = 1e-4
    """The same of squared second differences in time (K-Planes: Fridovich-Keil et al. 2023, eq. 5)."""
    fit: TimesFit = field(default_factory=TimesFit)
    """The fit through the waves."""

    def stages(self) -> Sequence[Stage]:
        """One."""
        return (HexPlaneStage(self),)


@dataclass(frozen=True)
class HexPlaneStage:
    """The random field, and its fit."""

    options: HexPlane
    name: str = "six planes through the waves"

    def start(self, task: Task, before: Stored | None) -> HexPlaneField:
        """The random field; `InputError` for a scan of one time."""
        times = require_times(task.scan)
        material = assumed_material(task.scan.at_instant(len(times) // 2), task.prior, task.on_progress, "cpu")
        grid, upper, planes = Grid.of_views(task.scan.views), task.bound(1.0), self.options.planes
        weights = planes.started(grid, len(times), upper, task.seed)
        return HexPlaneField(weights, grid, times, Matter.one(*material), upper, planes)

    def fit(self, task: Task, start: Stored) -> Fit:
        """The fit to the training frames."""
        options = self.options
        planes = {plane for pair in PAIRS for plane in pair}

        def costs(views: float) -> Sequence[Cost]:
            return [Roughness(options.roughness / views), Jerkiness(options.jerkiness / views)]

        def rate(name: str) -> float:
            return options.rate if name in planes else options.decoder_rate

        return times_fit(task, start, options.fit, rate, costs)


class Roughness:
    """Mean squared differences of features between neighbours in space, of all planes, times the voxels."""

    name = "roughness"

    def __init__(self, weight: float) -> None:
        self.weight = weight

    def __call__(self, moving: Any, seen: Sequence[tuple[float, VoxelGrid]]) -> Tensor:
        """Of the planes as they are."""
        found = list[Tensor]()
        for name, plane in moving.parameters().items():
            axes = (2,) if name in TIME_PLANES else (1, 2) if plane.ndim == 3 else ()
            found += [plane.diff(dim=axis).square().mean() for axis in axes if plane.shape[axis] > 1]
        return torch.stack(found).sum() * seen[0][1].values.numel()


class Jerkiness:
    """Mean squared second differences in time of the features of the planes of time, times the voxels."""

    name = "jerkiness"

    def __init__(self, weight: float) -> None:
        self.weight = weight

    def __call__(self, moving: Any, seen: Sequence[tuple[float, VoxelGrid]]) -> Tensor:
        """Of the planes as they are; zero where there are no three nodes."""
        planes = [plane for name, plane in moving.parameters().items() if name in TIME_PLANES]
        if planes[0].shape[1] < 3:
            return planes[0].new_zeros(())
        bends = [plane.diff(n=2, dim=1).square().mean() for plane in planes]
        return torch.stack(bends).sum() * seen[0][1].values.numel()
