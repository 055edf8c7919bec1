"""Search for the end of a half turn: the projection at 180° is the mirror image of the one at 0°."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .consistency import Sinograms

PAIRS = 4
"""Steps up to which frames are compared."""
FEWEST = 20
"""Frames that a half turn has at least; longer steps change too much to be compared by."""
UNEVEN = 0.01
"""Share of a step by which steps may differ."""
CLEARLY = 4.0
"""So many times farther from what frames show must the scan's end be than the other one."""
SEEN = 0.05
"""Share of what steps change that must be at stake, or noise would decide."""
REACH, STEP = 2.0, 0.1
"""How far sideways frames are moved upon each other, and by what steps [columns]."""


@dataclass(frozen=True)
class HalfTurn:
    """A half turn of even steps whose last frame is at 180° from the first, or a step before that.

    said, found: the angle from the first frame to the last [rad], as the scan says and by the frames
    """

    said: float
    found: float

    def spread(self, angles: np.ndarray) -> np.ndarray:
        """Angles [V] [rad] of some frames, among them the first of the scan, estimated from the frames."""
        return angles[0] + (angles - angles[0]) * self.found / self.said

    def line(self) -> str:
        """The result in words."""
        said, found = np.rad2deg([self.said, self.found])
        why = "it is the mirror image of the first" if found > said else "that would be the frame after it"
        return (
            f"angles: the last frame is at {found:.3f}° from the first, not at {said:.3f}° as the scan says, "
            f"for {why}; all angles are spread accordingly"
        )


def ends_of(count: int) -> np.ndarray:
    """The frames at both ends of a scan of `count` frames that tell where a half turn ends."""
    return np.concatenate([np.arange(PAIRS + 1), np.arange(count - PAIRS - 1, count)])


def may_be_half(angles: np.ndarray) -> bool:
    """Whether angles [V] [rad], unwrapped, are of even steps, and end at 180° or a step before it."""
    steps = np.diff(angles)
    if len(angles) < FEWEST or np.ptp(steps) > UNEVEN * abs(steps.mean()):
        return False
    short = _short(angles)
    return round(short) in (0, 1) and abs(short - round(short)) < UNEVEN * len(angles)


def half_turn(angles: np.ndarray, ends: Sinograms, offset: float) -> HalfTurn | None:
    """The half turn of the frames at `angles` [V] [rad] that `may_be_half`, if it is clearly another one; else None.

    ends: the frames `ends_of` the scan; offset: of the axis [pixels]. Files often do not say whether 180° is the angle
    of the last frame or of one after it. How much frames differ that are k steps apart is seen at each end of the scan.
    Frames at one end and mirrored ones of the other differ by as much, and by a constant more, for light drifts.
    """
    positions = np.broadcast_to(ends.positions, (len(ends.values), ends.positions.shape[-1]))
    first = ends.values[: PAIRS + 1]
    last = np.stack([_mirrored(*frame, offset) for frame in zip(ends.values, positions)])[:PAIRS:-1]
    steps = list(range(1, PAIRS + 1))
    apart = np.array([_difference([*_pairs(first, first, k), *_pairs(last, last, k)]) for k in steps])
    across = np.array([_difference(_pairs(first, last[::-1], PAIRS - k)) for k in range(PAIRS + 1)])
    away = [_away(across[[k - short for k in steps]], apart) for short in (0, 1)]
    short = round(_short(angles))
    if away[short] < max(CLEARLY * away[1 - short], SEEN * float(np.ptp(apart))):
        return None
    count = len(angles)
    return HalfTurn(float(np.ptp(angles)), np.pi if short else np.pi * (1 - 1 / count))


def _short(angles: np.ndarray) -> float:
    """How many steps are left from the last angle to 180° from the first."""
    span = float(np.ptp(angles))
    return (np.pi - span) / (span / (len(angles) - 1))


def _mirrored(image: np.ndarray, positions: np.ndarray, offset: float) -> np.ndarray:
    """An image [B, W] mirrored at the axis."""
    return np.stack([np.interp(2 * offset - positions, positions, row) for row in image])


def _pairs(a: np.ndarray, b: np.ndarray, apart: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Images i of `a` with those i + `apart` of `b`."""
    return list(zip(a[: len(a) - apart], b[apart:]))


def _difference(pairs: list[tuple[np.ndarray, np.ndarray]]) -> float:
    """Mean square of the differences of pairs of images [B, W] beside their means, moved sideways upon each other."""
    columns, edge = np.arange(pairs[0][0].shape[-1]), int(REACH) + 1
    shifts = np.arange(-REACH, REACH + STEP / 2, STEP)
    squares = []
    for a, b in pairs:
        moved = (np.stack([np.interp(columns + shift, columns, row) for row in b]) for shift in shifts)
        left = ((a - image)[:, edge:-edge] for image in moved)
        squares.append(min(float(each.var()) for each in left))
    return float(np.mean(squares))


def _away(across: np.ndarray, apart: np.ndarray) -> float:
    """How far differences of mirrored frames are from those of others, and a constant more."""
    more = across - apart
    return float(np.sqrt(np.square(more - max(0.0, float(more.mean()))).mean()))
