"""Consistency of projections of one rotating body: their moments are trigonometric polynomials of the angle.

For a slice of the body with projections p(θ, s), `∫ p(θ, s) U_n(s) ds` is a trigonometric polynomial in θ, of degree n
and of n's parity (Helgason 1980, *The Radon Transform*; Ludwig 1966, "The Radon transform on Euclidean space"). So
no reconstruction is needed to test the place of the rotation axis.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..checks import require
from ..inference import Compared
from ..progress import Advance

FEWEST_SAMPLES = 5.0
"""Columns for a half wave of the highest order, at least: higher orders are hardly sampled, and see noise."""
LOWEST = 4
"""The lowest order that is judged, where there are others: light that drifts is taken for matter in lower ones."""
FREE_VIEWS = 1 / 3
"""Share of the views that an order must leave for judging, beside its polynomial."""


@dataclass(frozen=True)
class Sinograms:
    """Projections of slices.

    values: [V, B, W] float64, of B slices
    angles: [V] [rad]
    positions: [V, W] or [1, W] of the columns' centres, from the nominal axis [pixels]
    heights: [B] of the slices along the axis [pixels]
    """

    values: np.ndarray
    angles: np.ndarray
    positions: np.ndarray
    heights: np.ndarray

    def binned(self, factor: int) -> Sinograms:
        """Columns averaged `factor` by `factor`; what is left over at the end is dropped. Lengths stay in pixels."""
        count = self.values.shape[-1] // factor
        values, positions = (
            array[..., : count * factor].reshape(*array.shape[:-1], count, factor).mean(-1)
            for array in (self.values, self.positions)
        )
        return Sinograms(values, self.angles, positions, self.heights)


@dataclass(frozen=True)
class MirroredPairs:
    """Rows of frames half a turn apart, of which one is the mirror image of the other about the axis.

    one, other: [P, B, W] of P pairs, in B slices
    positions: [W] of the columns' centres, from the nominal axis [pixels]
    """

    one: np.ndarray
    other: np.ndarray
    positions: np.ndarray

    @classmethod
    def of(cls, sinograms: Sinograms) -> MirroredPairs | None:
        """Those of frames that are half a turn apart to half a step; None where there are fewer than two."""
        angles, positions = sinograms.angles % (2 * np.pi), sinograms.positions
        steps = np.diff(np.unique(angles.round(6)))
        if len(positions) > 1 or len(steps) == 0:
            return None
        apart = np.abs((angles[None] - angles[:, None]) % (2 * np.pi) - np.pi)
        nearest = apart.argmin(1)
        first = np.flatnonzero((apart.min(1) < 0.5 * np.median(steps)) & (np.arange(len(angles)) < nearest))
        values = sinograms.values
        return cls(values[first], values[nearest[first]], positions[0]) if len(first) > 1 else None

    def told(self, offset: float) -> np.ndarray:
        """Logarithms [P] of the likelihood ratio that frames mirror each other about `offset` [pixels], against none:
        `-n/2 log(1 - r²)` of their correlation r in the n pixels that both have."""
        columns, at = np.arange(len(self.positions)), 2 * offset - self.positions
        step = self.positions[1] - self.positions[0]
        at = (at - self.positions[0]) / step
        both = (at >= 0) & (at <= columns[-1])
        if both.sum() < 2:
            return np.zeros(len(self.one))
        low = np.minimum(at[both].astype(int), columns[-2])
        share = at[both] - low
        one, other = self.one[..., both], (1 - share) * self.other[..., low] + share * self.other[..., low + 1]
        one, other = (rows - rows.mean(-1, keepdims=True) for rows in (one, other))
        sums = [(a * b).sum((1, 2)) for a, b in ((one, other), (one, one), (other, other))]
        r = np.clip(sums[0] / np.sqrt(np.maximum(sums[1] * sums[2], 1e-300)), 0.0, 1 - 1e-9)
        return -0.5 * one[0].size * np.log1p(-(r**2))

    def likeliest(self, places: np.ndarray) -> tuple[float, np.ndarray]:
        """The likeliest of `places` [pixels], and the table [T, P] of all."""
        table = np.stack([self.told(float(place)) for place in places])
        return float(places[table.sum(1).argmax()]), table


class Consistency:
    """How far projections are from those of one turning body, if the axis lies elsewhere than said."""

    def __init__(self, sinograms: Sinograms, reach: float) -> None:
        """reach: the farthest from the axis that any column lies, wherever the axis is looked for [pixels]."""
        self._of, self._reach = sinograms, reach
        views, width = len(sinograms.angles), sinograms.values.shape[-1]
        step = float(np.abs(np.diff(sinograms.positions[0])).mean())
        highest = int(np.pi * reach / (FEWEST_SAMPLES * step))
        lowest = LOWEST if views >= 2 * LOWEST else 2
        spaces = [polynomials(n, sinograms.angles) for n in range(lowest, max(lowest, min(highest, width)) + 1)]
        self._spaces = [space for space in spaces if space.shape[1] <= max((1 - FREE_VIEWS) * views, lowest + 2)]
        self.orders = np.arange(lowest, lowest + len(self._spaces))
        self.freedom = np.array([views - space.shape[1] for space in self._spaces])

    def unexplained(self, offset: float) -> np.ndarray:
        """Sums of squares [N, B] of each order that no body explains, with the axis at `offset` [pixels]."""
        inside = np.clip((self._of.positions - offset) / self._reach, -1, 1)
        values, found = self._of.values, np.empty((len(self.orders), self._of.values.shape[1]))
        half, sines = np.arccos(inside), np.sqrt(np.maximum(1 - inside**2, 1e-12))
        for i, (n, space) in enumerate(zip(self.orders, self._spaces)):
            weights = np.sin((n + 1) * half) / sines  # U_n(cos t) = sin((n + 1) t) / sin t
            moments = values @ weights[0] if len(weights) == 1 else np.einsum("vbw,vw->vb", values, weights)
            found[i] = ((moments - space @ (space.T @ moments)) ** 2).sum(0)
        return found


def polynomials(order: int, angles: np.ndarray) -> np.ndarray:
    """Orthonormal columns [V, K] of the trigonometric polynomials that moments of this order are, and a constant.

    The constant stands for what all frames have in common, such as dust on a single flat field; it costs the centre of
    mass, whose sinusoid would tell the axis where frames have no such faults, but leaves all other orders.
    """
    waves = np.arange(order % 2, order + 1, 2)
    columns = [np.cos(m * angles) for m in waves] + [np.sin(m * angles) for m in waves if m > 0]
    if order % 2:
        columns.append(np.ones_like(angles))
    left, sizes, _ = np.linalg.svd(np.stack(columns, axis=1), full_matrices=False)
    return left[:, sizes > 1e-9 * sizes[0]]


ROUNDS = 20
"""Rounds in which scatter and mean are found from each other; they settle in fewer."""
FAR = 3.0
"""Estimates farther from the mean than so many of their deviations count for less (Huber 1964)."""
NORMAL = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""


@dataclass(frozen=True)
class Estimate:
    """A number and its standard error."""

    value: float
    error: float

    def compared(self, name: str) -> Compared:
        """The hypothesis `name`, that the number is not zero: the logarithm of its likelihood ratio `z²/2`, whose
        standard deviation is |z|, the number over its error (Cox 1961, Proc. 4th Berkeley Symp. 1, 105)."""
        z = abs(self.value) / max(self.error, 1e-300)
        return Compared(name, 0.5 * z**2, z)


def combined(values: np.ndarray, errors: np.ndarray) -> Estimate:
    """The mean of K estimates with their standard errors, and its own: they also differ by what no error tells.

    The scatter beyond the errors is the same for all (random effects, DerSimonian & Laird 1986), and taken of the
    median, so that a few estimates may be altogether wrong.
    """
    mean, scatter = _median(values, 1 / errors**2), 0.0
    for _ in range(ROUNDS):
        away = np.abs(values - mean)
        scatter = float(np.sqrt(max(NORMAL**2 * _median(away, np.ones_like(away)) ** 2 - np.median(errors) ** 2, 0.0)))
        weights = 1 / (errors**2 + scatter**2)
        weights = weights * np.minimum(1, FAR / np.maximum(away * np.sqrt(weights), 1e-12)) ** 2
        mean = float((weights * values).sum() / weights.sum())
    return Estimate(mean, float(1 / np.sqrt(weights.sum())))


def _median(values: np.ndarray, weights: np.ndarray) -> float:
    """The weighted median, linear between values."""
    order = np.argsort(values)
    share = np.cumsum(weights[order]) - 0.5 * weights[order]
    return float(np.interp(0.5 * weights.sum(), share, values[order]))


FEWEST_SLICES = 4
"""Slices that a lean needs at least."""
LEANS = 24
"""Leans that are tried on either side of a first one."""


@dataclass(frozen=True)
class AxisSearch:
    """Residuals with the axis at each of T offsets.

    offsets: [T], evenly spaced [pixels]
    unexplained: [T, N, B] sums of squares of each order, in each slice
    freedom: [N] numbers in each of these sums
    octaves: [N] which octave each order belongs to
    heights: [B] of the slices [pixels]
    """

    offsets: np.ndarray
    unexplained: np.ndarray
    freedom: np.ndarray
    octaves: np.ndarray
    heights: np.ndarray

    @classmethod
    def of(cls, sinograms: Sinograms, near: float, reach: float, step: float, on_progress: Advance) -> AxisSearch:
        """Offsets within `reach` of `near`, `step` apart [pixels]."""
        count = max(2, int(np.ceil(reach / step)))
        offsets = near + step * np.arange(-count, count + 1)
        judge = Consistency(sinograms, float(np.abs(sinograms.positions).max() + np.abs(offsets).max()))
        found = []
        for t, offset in enumerate(offsets):
            found.append(judge.unexplained(float(offset)))
            on_progress((t + 1) / len(offsets))
        tiny = 1e-18 * float((sinograms.values**2).sum()) + 1e-300
        octaves = np.log2(judge.orders).astype(int)
        return cls(offsets, np.stack(found) + tiny, judge.freedom, octaves, sinograms.heights)

    def likeliest(self) -> tuple[float, float]:
        """The likeliest offset [pixels] and lean [columns a row], all orders together.

        Errors: `InputError` where the offset is at the end of those that were tried.
        """
        every = np.ones(len(self.octaves), dtype=bool)
        leans, curves = self._curves(every, 0.0)
        best = int(curves.min(1).argmin())
        at = int(curves[best].argmin())
        require(
            0 < at < len(self.offsets) - 1,
            "the projections tell no axis within the field; check the angles, or say where it is by --axis-column.",
        )
        return float(self.offsets[at]), float(leans[best])

    def found(self, lean: float) -> tuple[Estimate, Estimate | None]:
        """The offset [pixels] and, of enough slices, the lean [columns a row] near `lean`, with their errors.

        Each octave of orders gives its own; how they scatter says what noise alone does not (light that drifts, matter
        beyond the field). Errors: `InputError` where none of them has an optimum.
        """
        places, slopes = [], []
        for octave in np.unique(self.octaves):
            leans, curves = self._curves(self.octaves == octave, lean)
            best = int(curves.min(1).argmin())
            places.append(minimum(self.offsets, curves[best]))
            slopes.append(minimum(leans, curves.min(1)) if len(leans) > 1 else None)
        places, slopes = ([each for each in found if each is not None] for found in (places, slopes))
        require(bool(places), "the projections tell no axis; check the angles, or say where it is by --axis-column.")
        offset = combined(*np.array(places).T)
        return offset, combined(*np.array(slopes).T) if slopes else None

    def _curves(self, orders: np.ndarray, lean: float) -> tuple[np.ndarray, np.ndarray]:
        """Leans [L] about `lean`, and minus the logarithms of the likelihood [L, T] of offsets with each of them.

        Each order has a noise of its own, the same in all slices, which is not known: it is eliminated.
        """
        table, heights = self.unexplained[:, orders], self.heights
        half = 0.5 * float(np.ptp(heights)) if len(heights) >= FEWEST_SLICES else 0.0
        step = self.offsets[1] - self.offsets[0]
        leans = np.array([lean]) if half == 0 else lean + np.arange(-LEANS, LEANS + 1) * step / half
        count = len(heights) * self.freedom[orders]
        curves = []
        for slope in leans:
            sums = np.zeros(table.shape[:2])
            for b, height in enumerate(heights):
                sums += shifted(table[..., b], slope * height / step)
            curves.append(0.5 * (count * np.log(sums)).sum(1))
        return leans, np.array(curves)


def shifted(table: np.ndarray, by: float) -> np.ndarray:
    """Rows [T, N] of a table at `t + by`, linear between rows; beyond its ends, as there."""
    at = np.clip(np.arange(len(table)) + by, 0, len(table) - 1)
    low = np.minimum(at.astype(int), len(table) - 2)
    share = (at - low)[:, None]
    return (1 - share) * table[low] + share * table[low + 1]


def minimum(places: np.ndarray, curve: np.ndarray) -> tuple[float, float] | None:
    """The minimum of a curve through a parabola, and its standard error; None at an end, or where it does not bend."""
    best = int(curve.argmin())
    if not 0 < best < len(curve) - 1:
        return None
    left, middle, right = curve[best - 1 : best + 2]
    step, bend = places[1] - places[0], left - 2 * middle + right
    if bend <= 0:
        return None
    return float(places[best] + 0.5 * step * (left - right) / bend), float(step / np.sqrt(bend))


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
