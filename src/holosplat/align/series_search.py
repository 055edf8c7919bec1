"""One geometry of the beams for all times of a series: the times that are used, and the joint search."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from ..checks import require
from ..matter import DeltaBeta
from ..progress import Advance
from ..scan import Exposures, Scan
from .derivatives import NUMBERS, Normal, step
from .poses import DISTANCE, MAGNIFICATION, TURNING, Level, PoseOptions, PoseSearch

ALIKE = 1e-6
"""Planned poses that differ by less (rotation matrices; shifts in pixels) are those of one beam."""


@dataclass(frozen=True)
class Beams:
    """The beams of a series, whose geometry is the same, or drifts slowly, at all times.

    of_frame: [N] which beam each frame is of, counted from 0 in the order of their first frames
    planned: the B exposures, at time 0
    """

    of_frame: np.ndarray
    planned: Exposures

    @classmethod
    def of(cls, scan: Scan) -> Beams:
        """Frames of a series of the same planned pose, distance, energy and blur are of one beam; of one time, each is.

        Errors: `InputError` where two frames of one time are of one beam, or none is seen again at another time.
        """
        exposures = scan.exposures
        if not scan.is_series:
            return cls(np.arange(len(scan)), exposures)
        views = exposures.views
        table = np.concatenate(
            [
                views.rotations.reshape(len(exposures), 9) / ALIKE,
                views.shifts / views.pixel_sizes[:, None] / ALIKE,
                views.pixel_sizes[:, None] / views.pixel_sizes[0] / ALIKE,
                np.stack([exposures.distance, exposures.energy_kev], axis=1) / (ALIKE * exposures.energy_kev[0]),
                exposures.psf_sigma_px[:, None] / ALIKE,
            ],
            axis=1,
        )
        _, first, group = np.unique(np.round(table), axis=0, return_index=True, return_inverse=True)
        order = np.argsort(np.argsort(first))
        of_frame = order[group.reshape(-1)]
        pairs = np.unique(np.stack([of_frame, exposures.time], axis=1), axis=0)
        require(
            len(pairs) == len(exposures),
            "align needs beams that are apart, but the series has two frames of one planned pose at one time; "
            "leave one of them (--views).",
        )
        require(
            len(first) < len(exposures),
            "align needs beams that stay where they are over the times of a series, but no planned pose comes twice; "
            "choose one time with --time-frame.",
        )
        planned = exposures[np.sort(first)]
        return cls(of_frame, replace(planned, time=np.zeros(len(planned))))

    def __len__(self) -> int:
        return len(self.planned)


@dataclass(frozen=True)
class Moment:
    """The frames of one time.

    scan: frames of V of the beams; beams: [V] which; time: [s]; when: the same from -1 (the first of the series) to 1
    """

    scan: Scan
    beams: np.ndarray
    time: float
    when: float


def whens(time: np.ndarray) -> np.ndarray:
    """Times [N] [s] as -1 (the first) to 1 (the last)."""
    first, last = time.min(), time.max()
    if first == last:
        return np.zeros(len(time))
    return 2 * (time - first) / (last - first) - 1


def chosen_moments(scan: Scan, beams: Beams, most: int, fewest: int) -> list[Moment]:
    """`most` times of a series, or all if there are no more, evenly spread; of each part the most informative one.

    The times are divided into as many parts as are to be chosen. Of each part that time is taken whose training
    frames carry most information on shifts: the sum of the squares of their slopes (Fisher 1922), in even noise. Only
    times with the most beams for training count; frames held out of a beam that is for training elsewhere do not.
    Errors: `InputError` unless some time has `fewest` training frames.
    """
    is_test = scan.is_test
    time = scan.exposures.time if scan.is_series else np.zeros(len(scan))
    for_training = np.unique(beams.of_frame[~is_test])
    keep = ~(is_test & np.isin(beams.of_frame, for_training))
    instants = np.unique(time)
    counts = np.array([(~is_test[time == t]).sum() for t in instants])
    require(
        int(counts.max()) >= fewest,
        f"align needs {fewest} training frames of one time at least, but there are {int(counts.max())}.",
    )
    full = instants[counts == counts.max()]
    said = np.array([_information(scan, np.flatnonzero((time == t) & ~is_test)) for t in full])
    parts = np.array_split(np.arange(len(full)), min(most, len(full)))
    best = [part[np.argmax(said[part])] for part in parts]
    when = whens(time)
    found = []
    for t in full[best]:
        index = np.flatnonzero((time == t) & keep)
        found.append(Moment(scan[index].as_static(), beams.of_frame[index], float(t), float(when[index[0]])))
    return found


def _information(scan: Scan, index: np.ndarray) -> float:
    """Sum of squared slopes of the frames `index`."""
    frames = scan[index].frames
    return float(sum(np.square(np.diff(frames, axis=axis)).sum() for axis in (1, 2)))


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
