"""A few volumes that courses of time mix, fitted through the waves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar

from holosplat.baselines import HolographicTV
from holosplat.checks import at_least
from holosplat.fit.loop import Fit
from holosplat.methods.method import Method, Stage, Task
from holosplat.ranges import Rate, ranged
from holosplat.representations import Stored

from .each_time import EachTimeStage, usual_start
from .moving_voxels import LowRankVoxels, VoxelSeries
from .through_waves import TimesFit, times_fit


@dataclass(frozen=True)
@ranged
class LowRank(Method):
    """Options of voxels of low rank, and of their start."""

    kind: ClassVar[str] = "low-rank"
    of_series: ClassVar[bool] = True
    likelier: ClassVar[bool] = True

    volume: HolographicTV = field(default_factory=usual_start)
    """The start: each time by itself, of which the nearest matter of low rank is taken."""
    rank: int = 8
    """Volumes (at most as many as times)."""
    rate: Rate = 0.003
    """Adam's first rate of the volumes, whose courses have a mean square of one."""
    course_rate: Rate = 0.002
    """The same of the courses."""
    fit: TimesFit = field(default_factory=TimesFit)
    """The fit through the waves."""

    def __post_init__(self) -> None:
        at_least(self, 1, "rank")

    def stages(self) -> Sequence[Stage]:
        """Each time by itself, and the fit."""
        return (EachTimeStage(self.volume), LowRankStage(self))


@dataclass(frozen=True)
class LowRankStage:
    """The fit of volumes and courses."""

    options: LowRank
    name: str = "voxels of low rank through the waves"

    def start(self, task: Task, before: Stored | None) -> LowRankVoxels:
        """The nearest matter of low rank to the volumes of the times."""
        assert isinstance(before, VoxelSeries)
        return LowRankVoxels.nearest(before, self.options.rank)

    def fit(self, task: Task, start: Stored) -> Fit:
        """The fit to the training frames."""
        rates = {"volumes": self.options.rate, "courses": self.options.course_rate}
        return times_fit(task, start, self.options.fit, rates.__getitem__)
