"""One geometry of the beams for all times of a series: each time has its own volume, the beams' numbers are shared."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from ..matter import DeltaBeta
from ..progress import Advance
from .derivatives import NUMBERS
from .moments import Moment
from .newton import Normal, step
from .poses import DISTANCE, MAGNIFICATION, TURNING, Level, PoseOptions, PoseSearch


class SeriesSearch:
    """Numbers of B beams, and of each of some times a volume.

    numbers: [B, 8], at the middle of the series; rates: [B, 8], how much more at its end; covariances: [B, 16, 16] of
    both, for known volumes
    """

    def __init__(
        self, moments: Sequence[Moment], beams: int, material: DeltaBeta, options: PoseOptions, upper: float | None
    ) -> None:
        self.moments, self.options = list(moments), options
        self.searches = [PoseSearch(moment.scan, material, options, upper, begin=False) for moment in moments]
        count = len(NUMBERS)
        self.numbers = torch.zeros(beams, count, dtype=torch.float64)
        self.rates = torch.zeros(beams, count, dtype=torch.float64)
        self._held = torch.ones(2 * count, dtype=torch.float64)
        self.covariances = torch.zeros(beams, 2 * count, 2 * count, dtype=torch.float64)

    def levels(self) -> tuple[Level, ...]:
        """All levels, in their order."""
        return self.searches[0].levels()

    def hold(self, *places: int) -> None:
        """From now on these numbers stay as they are."""
        for place in places:
            self._held[[place, place + len(NUMBERS)]] = 0

    def forget_distance(self) -> None:
        """Distances as planned: what voxels find of them is what their edges are too soft for."""
        self.numbers[:, DISTANCE] = 0
        self.rates[:, DISTANCE] = 0

    def run(self, level: Level, on_progress: Advance) -> None:
        """All rounds of a level: the volumes of all times, then one step of the beams' numbers."""
        prepared = [search.prepared(level) for search in self._placed()]
        turning = min(prepared[0].shape) >= TURNING
        done, whole = 0, level.rounds * len(self.moments)
        for _ in range(level.rounds):
            said = list[Normal]()
            for search, at in zip(self._placed(), prepared):
                said.append(search.looked(at))
                done += 1
                on_progress(done / whole)
            self.solve(said, turning)

    def _placed(self) -> list[PoseSearch]:
        """The searches of all times, with the beams' numbers as they are now."""
        for search, moment in zip(self.searches, self.moments):
            search.numbers = (self.numbers + moment.when * self.rates)[torch.from_numpy(moment.beams)]
        return self.searches

    def solve(self, said: Sequence[Normal], turning: bool) -> None:
        """One damped step of numbers and rates together, as `newton.step` of one time, by what all times say."""
        sums = _Sums(len(self.numbers))
        for normal, moment in zip(said, self.moments):
            sums.add(normal, moment)
        drift = torch.zeros(len(NUMBERS), dtype=torch.float64)
        drift[:5] = torch.from_numpy(self.options.drift.pose()) * torch.tensor([1, 1, turning, turning, turning])
        here = self.options.uncertain.deviations(turning)
        expected = self._held * torch.cat([here, drift * (here > 0)])
        both = torch.cat([self.numbers, self.rates], dim=1)
        moved = step(sums.normal(), both, expected)
        self.numbers, self.rates = moved.numbers.split(len(NUMBERS), dim=1)
        self.numbers[:, MAGNIFICATION] -= self.numbers[:, MAGNIFICATION].mean()  # of a larger object nothing is seen
        self.covariances = moved.covariances


class _Sums:
    """The normal equations of numbers and rates: frames at the time τ see numbers + τ rates."""

    def __init__(self, beams: int) -> None:
        count = 2 * len(NUMBERS)
        self._information = torch.zeros(beams, count, count, dtype=torch.float64)
        self._slope = torch.zeros(beams, count, dtype=torch.float64)

    def add(self, normal: Normal, moment: Moment) -> None:
        """Add the information of the frames of one time."""
        powers = torch.tensor([1.0, moment.when], dtype=torch.float64)
        beams = torch.from_numpy(moment.beams)
        information = torch.einsum("a,b,vij->vaibj", powers, powers, normal.information)
        slope = torch.einsum("a,vi->vai", powers, normal.slope)
        self._information.index_add_(0, beams, information.reshape(len(beams), *self._information.shape[1:]))
        self._slope.index_add_(0, beams, slope.reshape(len(beams), -1))

    def normal(self) -> Normal:
        return Normal(self._information, self._slope)
