"""The times of a series that its beams are found from: which frame is of which beam, and which times say most."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..checks import require
from ..scan import Exposures, Scan

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
