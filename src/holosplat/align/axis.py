"""The axis of a turning object, from projections alone: its column, and how it leans sideways."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from ..checks import InputError, at_least, in_range, require
from ..frames import evenly
from ..geometry import rotation_y
from ..inference import Compared, Decision
from ..optics.background import LightOptions
from ..progress import Advance
from ..ranges import checked_dataclass
from ..rotations import angles_about_y
from ..scan import Exposures, Scan
from .consistency import (
    Consistency,
    Estimate,
    HalfTurn,
    MirroredPairs,
    Sinograms,
    combined,
    ends_of,
    half_turn,
    may_be_half,
)
from .views import EVEN_OR_NOT, shadows

PLACE, BY_ALL, BY_MIRROR = "place of the axis", "consistency of all frames", "frames half a turn apart"
STEP = 0.25
"""Distance of the places that are tried [columns]; a parabola finds the place between them."""
LEAN, UPRIGHT, LEANING = "lean of the axis", "as the scan says", "leaning"
FINE_REACH = 4
"""How far beside the place that a coarse search finds a fine one looks [columns]."""
GROUPS = 8
"""Groups of pairs of frames half a turn apart, whose axes tell the error of their mean."""
FEWEST_VIEWS = 6
"""Fewer views than this leave nothing to judge an axis by."""


@checked_dataclass
class AxisOptions:
    """How the axis of a turning object is looked for."""

    within: float = 0.3
    """How far from where the scan says it is, as a share of the frames' width."""
    bands: int = 16
    """Rows are averaged to so many slices at most: enough for a lean, and neighbouring rows differ little."""
    columns: int = 512
    """Columns are averaged to so many at most; the place is found to some hundredths of one."""
    views: int = 256
    """Views that are looked at, at most, evenly spread: more add little and take time."""

    def __post_init__(self) -> None:
        in_range("within", self.within, 0.01, 0.5)
        at_least(self, 1, "bands")
        at_least(self, 32, "columns")
        at_least(self, FEWEST_VIEWS, "views")


@dataclass(frozen=True)
class Axis:
    """The axis of a rotating object.

    offset: from where the scan said it is, at the middle of the object frame, along the columns [pixels]
    lean: of the axis in the image, columns a row; positive: further right further down; None: too few rows
    column: of the axis in the frames' middle row, 0 the middle of the first one; of the first view
    turn: where a half turn ends, if not where the scan says
    place: how its place was chosen, where frames half a turn apart tell one, too
    """

    offset: Estimate
    lean: Estimate | None
    column: float
    rows: int
    turn: HalfTurn | None = None
    place: Decision | None = None

    @property
    def leans(self) -> bool:
        """Whether the axis leans for sure."""
        return any(each.choice == LEANING for each in self.decisions)

    @cached_property
    def decisions(self) -> tuple[Decision, ...]:
        """On the place, where there are two, and on the lean, where the frames have enough rows."""
        made = () if self.place is None else (self.place,)
        if self.lean is None:
            return made
        found = self.lean.compared(LEANING)
        return (*made, Decision(LEAN, LEANING if found.wins else UPRIGHT, "likelihood ratio", (found,)))

    def applied(self, exposures: Exposures) -> Exposures:
        """The exposures with the axis where it is: detector shifts, a roll `ω_z = -atan(lean)` where it leans, and the
        angles of a half turn that ends elsewhere."""
        views, p = exposures.views, exposures.views.pixel_size
        rotations = views.rotations
        if self.turn is not None:
            angles = np.unwrap(angles_about_y(views.rotations))
            rotations = rotations @ rotation_y(np.rad2deg(self.turn.spread(angles) - angles))
        if self.leans and self.lean is not None:
            angle = -np.arctan(self.lean.value)
            c, s = np.cos(angle), np.sin(angle)
            rotations = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ rotations
        shifts = views.shifts - np.array([self.offset.value * p, 0.0])
        return replace(exposures, views=replace(views, rotations=rotations, shifts=shifts))

    def lines(self) -> list[str]:
        """The result in words."""
        moved = f"{self.offset.value:+.3f} from the scan's"
        said = [] if self.turn is None else [self.turn.line()]
        said.append(f"axis at column {self.column:.3f} ± {self.offset.error:.3f} ({moved})")
        if self.lean is None:
            few = self.place is None or self.place.choice == BY_ALL
            why = "have too few rows to tell" if few else "do not show all of the matter, so that they do not tell"
            said.append(f"lean of the axis: the frames {why}")
        else:
            degrees = np.rad2deg(np.arctan([self.lean.value, self.lean.error]))
            used = "" if self.leans else "; not sure, left as the scan says"
            said.append(f"lean of the axis {degrees[0]:+.3f}° ± {degrees[1]:.3f}°{used}")
        said.append(
            "sense of rotation: parallel beams cannot tell it, for the mirrored object that turns the other way gives "
            "the same frames; it stays as the scan says"
        )
        return said


def find_axis(
    scan: Scan,
    options: AxisOptions = AxisOptions(),
    *,
    ratio: float | None = None,
    light: LightOptions = EVEN_OR_NOT,
    on_progress: Advance = lambda fraction: None,
) -> Axis:
    """The axis of the object that turns in `scan`, from the consistency of its projections.

    Where matter leaves the frames, as in a half acquisition, projections are not consistent. Frames half a turn apart
    still mirror each other about the axis in the columns that both have. The axis at which they do best is taken where
    this is surely better than near the other one.

    ratio: δ/β, if it is known. Errors: `InputError` for views that turn about no common axis, for fewer than
    `FEWEST_VIEWS`, and where no place within the field is better than those beside it.
    """
    sinograms = sinograms_of(scan, options, ratio, light)
    pairs, found = MirroredPairs.of(sinograms), None
    try:
        found = _search_axis(scan, sinograms, options, on_progress)
    except InputError:
        if pairs is None:
            raise
    if pairs is not None:
        found = _against(pairs, found, scan)
    assert found is not None
    angles = np.unwrap(angles_about_y(scan.views.rotations))
    if not may_be_half(angles):
        return found
    ends = _sinograms(scan[ends_of(len(scan))], options, ratio, light)
    turn = half_turn(angles, ends, found.offset.value)
    if turn is None:
        return found
    turned = replace(sinograms, angles=turn.spread(np.unwrap(sinograms.angles)))
    return replace(_search_axis(scan, turned, options, on_progress), turn=turn)


def _against(pairs: MirroredPairs, found: Axis | None, scan: Scan) -> Axis:
    """The axis of frames half a turn apart, where it is surely better than the best one near `found`, or else `found`.

    Errors: `InputError` where there is neither.
    """
    near = np.arange(-FINE_REACH, FINE_REACH + STEP, STEP) * (pairs.positions[1] - pairs.positions[0])
    coarse, _ = pairs.likeliest(pairs.positions)
    best, table = pairs.likeliest(coarse + near)
    count = min(GROUPS, len(pairs.one))
    tried = [minimum(coarse + near, -table[:, n::count].sum(1)) for n in range(count)]
    places = np.array([place for place in tried if place is not None])
    before = None if found is None else pairs.likeliest(found.offset.value + near)[0]
    gains = pairs.told(best) - (0.0 if before is None else pairs.told(before))
    compared = Compared(BY_MIRROR, float(gains.mean()), float(gains.std(ddof=1) / np.sqrt(len(gains))))
    wins = compared.wins and len(places) > 1
    decision = Decision(PLACE, BY_MIRROR if wins else BY_ALL, "likelihood ratio", (compared,))
    if found is not None and not wins:
        return replace(found, place=decision)
    require(wins, "the projections tell no axis; check the angles, or say where it is by --axis-column.")
    offset = combined(*places.T)
    return Axis(offset, None, _middle(scan) + offset.value, scan.views.shape[0], place=decision)


def _middle(scan: Scan) -> float:
    """The column of the nominal axis in the first view, 0 the middle of the first one."""
    return 0.5 * (scan.views.shape[1] - 1) - float(scan.views.shifts[0, 0]) / scan.views.pixel_size


def _search_axis(scan: Scan, sinograms: Sinograms, options: AxisOptions, on_progress: Advance) -> Axis:
    """The axis of sinograms of `scan`."""
    width, columns = scan.views.shape[1], sinograms.values.shape[-1]
    factor, pitch = max(1, columns // 64), scan.views.shape[1] / columns
    first = AxisSearch.of(
        sinograms.binned(factor), 0.0, options.within * width, 0.5 * factor * pitch, lambda f: on_progress(0.5 * f)
    )
    near, lean = first.likeliest()
    reach = (2 * factor + FINE_REACH) * pitch + abs(lean) * 0.5 * float(np.ptp(sinograms.heights))
    fine = AxisSearch.of(sinograms, near, reach, STEP * pitch, lambda f: on_progress(0.5 + 0.5 * f))
    offset, leaning = fine.found(lean)
    return Axis(offset, leaning, _middle(scan) + offset.value, scan.views.shape[0])


def sinograms_of(scan: Scan, options: AxisOptions, ratio: float | None, light: LightOptions) -> Sinograms:
    """The sinograms of `scan`, in bands of rows; errors: those of `find_axis`."""
    views = scan.views
    scan.views.parallel("finding the rotation axis")
    require(
        views.shares_axis,
        "the axis is that of views which turn about the object's y axis alone, but these do not; align without "
        "--axis-only.",
    )
    chosen = evenly(len(scan), options.views)
    require(
        len(chosen) >= FEWEST_VIEWS,
        f"an axis needs {FEWEST_VIEWS} views at least, but there are {len(chosen)}; align without --axis-only.",
    )
    return _sinograms(scan[chosen], options, ratio, light)


def _sinograms(scan: Scan, options: AxisOptions, ratio: float | None, light: LightOptions) -> Sinograms:
    """Sinograms of all frames of `scan`."""
    views = scan.views
    (h, w), p = views.shape, views.pixel_size
    images = shadows(scan, ratio, light).numpy()
    edges = np.linspace(0, h, min(options.bands, h) + 1).round().astype(int)
    values = np.stack([_mean_row(images[:, a:b]) for a, b in pairwise(edges)], axis=1)
    heights = 0.5 * (edges[:-1] + edges[1:]) - h / 2 + views.shifts[0, 1] / p
    seen = ~np.isnan(values).any(axis=(0, 2))  # slices that all views see
    require(
        bool(seen.any()), "an axis needs slices that all views see; leave out views without pixels that have a value."
    )
    values, heights = values[:, seen], heights[seen]
    sideways = views.shifts[:, :1] / p
    positions = np.arange(w) + 0.5 - w / 2 + (sideways[:1] if np.ptp(sideways) < 1e-9 else sideways)
    return Sinograms(values, angles_about_y(views.rotations), positions, heights).binned(
        max(1, -(-w // options.columns))
    )


def _mean_row(images: np.ndarray) -> np.ndarray:
    """The mean row [V, W] of images [V, K, W] of which pixels that are NaN have no part; columns without any are those
    between their neighbours. NaN in views that have none."""
    known = ~np.isnan(images)
    count, rows = known.sum(1), np.where(known, images, 0).sum(1)
    rows = np.where(count > 0, rows / np.maximum(count, 1), np.nan)
    for row, there in zip(rows, count > 0):
        if there.any():
            row[~there] = np.interp(np.flatnonzero(~there), np.flatnonzero(there), row[there])
    return rows


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
