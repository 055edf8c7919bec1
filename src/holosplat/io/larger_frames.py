"""Scans that sweep more than a frame shows, as scans of larger frames.

Half acquisition: a whole turn with the axis near an edge of the frames, whose opposite frames complete each other. A
frame at θ + 180° is the mirror image of that at θ about the axis. Each frame of the first half turn is joined with its
opposite one to a frame as wide as what the turn sweeps, so that all that follows sees a usual scan of half a turn.

Helix: the object moves along the axis by more than a frame while it turns. Each frame is a part of a taller one, whose
other rows have no value. A tube about the axis is divided out here, too, for it needs the axis.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from ..checks import note, require, warn
from ..frames import Derived, Frames, Taken
from ..geometry import Views
from ..preprocess.pixels import filled
from ..ranges import checked_dataclass
from ..scan import Exposures, Scan
from ..tables import number_in, shown
from .angles import angles_of, is_half_acquisition


@dataclass(frozen=True)
class Raster:
    """Columns of wide frames. axis: column of the axis in the files' frames; width: of these."""

    axis: float
    width: int

    @property
    def first(self) -> int:
        """The first wide column, counted as those of the files' frames."""
        return min(0, math.ceil(self.mirrored_from))

    @property
    def mirrored_from(self) -> float:
        """Where the mirror image of a frame begins."""
        return 2 * self.axis - (self.width - 1)

    @property
    def columns(self) -> np.ndarray:
        """[W'] numbers of all wide columns."""
        return np.arange(self.first, max(self.width - 1, math.floor(2 * self.axis)) + 1)

    @property
    def reach(self) -> float:
        """Distance from the axis to the farther edge [pixels]."""
        return 0.5 * self.width + abs(self.axis - 0.5 * (self.width - 1))

    def weights(self) -> np.ndarray:
        """[2, W'] of the frame and of the mirrored one: the nearer to its own edge, the less; 0 beyond."""
        inside = [
            np.minimum(self.columns - start + 1, start + self.width - self.columns)
            for start in (0.0, self.mirrored_from)
        ]
        known = np.array([np.where(d >= 1 - 1e-9, d, 0.0) for d in inside])
        return known / known.sum(axis=0)

    def upright(self, frames: np.ndarray) -> np.ndarray:
        """Frames [K, H, W] on the wide columns, [K, H, W'], zero beyond."""
        wide = np.zeros((*frames.shape[:2], len(self.columns)), dtype=np.float64)
        wide[:, :, -self.first : self.width - self.first] = frames
        return wide

    def mirrored(self, frames: np.ndarray) -> np.ndarray:
        """Mirror images about the axis of frames [K, H, W] on the wide columns, by cubic splines between pixels."""
        from scipy.ndimage import shift  # which takes long to load

        start = math.ceil(self.mirrored_from - 1e-9)
        turned, between = frames[:, :, ::-1].astype(np.float64), start - self.mirrored_from
        turned = turned if abs(between) < 1e-9 else shift(turned, (0, 0, -between), order=3, mode="nearest")
        wide, place = np.zeros((*frames.shape[:2], len(self.columns))), start - self.first
        count = min(self.width, len(self.columns) - place)
        wide[:, :, place : place + count] = turned[:, :, :count]
        return wide


class Rearranged(Derived):
    """Frames made from those of a scan, which are read when they are asked for."""

    def __init__(self, scan: Scan, shape: tuple[int, int, int]) -> None:
        self.source, self.shape = scan.source, shape
        self.missing = None if isinstance(scan.source, Frames) else scan.missing

    def taken(self, numbers: np.ndarray) -> Taken:
        """The scan's frames `numbers` [K], with their missing pixels."""
        if isinstance(self.source, Frames):
            return self.source.with_missing(numbers)
        return self.source[numbers], None if self.missing is None else self.missing[numbers]


class Stitched(Rearranged):
    """Wide frames of a scan's, each of one and the opposite one, which `pairs` [n, 2] number."""

    def __init__(self, scan: Scan, pairs: np.ndarray, raster: Raster) -> None:
        super().__init__(scan, (len(pairs), scan.views.shape[0], len(raster.columns)))
        self._pairs, self._raster = pairs, raster

    def with_missing(self, numbers: np.ndarray) -> Taken:
        """See `Frames.with_missing`."""
        total, weight = np.zeros((2, len(numbers), *self.shape[1:]))
        ways = (self._raster.upright, self._raster.mirrored)
        for which, place, share in zip(self._pairs[numbers].T, ways, self._raster.weights()):
            frames, missing = self.taken(which)
            known = share if missing is None else share * (place(missing.astype(np.float32)) < 0.5)
            total += place(frames) * known
            weight += known
        none = weight == 0
        found = (total / np.where(none, 1, weight)).astype(np.float32)
        if not none.any():
            return found, None
        return filled("the stitched frames", found, np.zeros(none.shape, dtype=bool), none, numbers)


class Placed(Rearranged):
    """A scan's frames from row `first` [N] on in `rows` rows; other rows are missing, and repeat the outermost."""

    def __init__(self, scan: Scan, first: np.ndarray, rows: int) -> None:
        super().__init__(scan, (len(first), rows, scan.views.shape[1]))
        self._first = first

    def with_missing(self, numbers: np.ndarray) -> Taken:
        """See `Frames.with_missing`."""
        frames, missing = self.taken(numbers)
        row = np.arange(self.shape[1]) - self._first[numbers][:, None]
        nearest = row.clip(0, frames.shape[1] - 1)[:, :, None]
        gaps = np.zeros((len(numbers), *self.shape[1:]), dtype=bool)
        gaps |= (row != nearest[:, :, 0])[:, :, None]
        if missing is not None:
            gaps |= np.take_along_axis(missing, nearest, 1)
        return np.take_along_axis(frames, nearest, 1), gaps


def heightened(scan: Scan) -> Scan:
    """The scan on frames as tall as all views together, which it says, for one that moves farther along one axis than a
    frame."""
    views = scan.views
    upright = np.allclose(views.rotations[:, 1], [0.0, 1.0, 0.0]) and views.has_one_pixel and views.sources is None
    rows, height = views.shifts[:, 1] / views.pixel_size if upright else np.zeros(len(views)), views.shape[0]
    if scan.is_series or not len(views) or np.ptp(rows) < height:
        return scan
    first = np.round(rows - rows.min()).astype(int)
    more = int(first.max())
    frames = Placed(scan, first, height + more)
    shifts = views.shifts.copy()
    shifts[:, 1] = (rows - first + 0.5 * more) * views.pixel_size
    note(
        f"helix: the frames move by {np.ptp(rows):.4g} rows along the axis, and become parts of frames of "
        f"{height + more} rows in place of {height}"
    )
    tall = replace(views, shifts=shifts, shape=(height + more, views.shape[1]))
    said = scan.provenance | {"heightened": "a helix"}
    return Scan.of(frames, replace(scan.exposures, views=tall), scan.is_test, said)


def of_parts(found: Exposures, tall: Scan, scan: Scan) -> Exposures:
    """The exposures of the frames of `scan`, from those `found` of the frames of `tall`, its `heightened` scan."""
    shifts = found.views.shifts + scan.views.shifts - tall.views.shifts
    return replace(found, views=replace(found.views, shifts=shifts, shape=scan.views.shape))


def stitched(scan: Scan) -> Scan:
    """The scan of half a turn on wider frames, which it says, for a half acquisition whose frames all have opposite
    ones."""
    if not is_half_acquisition(scan):
        return scan
    views, angles = scan.views, angles_of(scan.views)
    assert angles is not None
    raster = Raster(0.5 * (views.shape[1] - 1) - float(views.shifts[0, 0]) / views.pixel_size, views.shape[1])
    first = np.flatnonzero((angles - angles[0] + 1e-6) % 360 < 180)
    away = np.abs((angles[first, None] + 180 - angles[None] + 180) % 360 - 180)
    pairs = np.stack([first, away.argmin(axis=1)], axis=1)
    if round(math.radians(float(away.min(axis=1).max())) * raster.reach) > 0:  # whole pixels, of the outermost matter
        warn(
            f"the axis is at column {raster.axis:.4g} of {raster.width}, far from the middle: a turn sweeps "
            f"{2 * raster.reach:.0f} pixels, but the volume is as wide as a frame, and matter beyond it is cut off; "
            "frames are joined to wider ones only where each has an opposite one"
        )
        return scan
    frames = Stitched(scan, pairs, raster)
    columns, exposures = raster.columns, scan.exposures[first]
    shifts = exposures.views.shifts.copy()
    shifts[:, 0] = (raster.first - raster.axis - 0.5 + 0.5 * len(columns)) * views.pixel_size
    wide = replace(exposures.views, shifts=shifts, shape=(views.shape[0], len(columns)))
    note(
        f"half acquisition: {len(scan)} frames of {views.shape[1]} columns with the axis at column {raster.axis:.4g} "
        f"are joined, each with the opposite one, to {len(first)} frames of {len(columns)} columns"
    )
    held_out = scan.is_test[pairs[:, 0]] | scan.is_test[pairs[:, 1]]
    return Scan.of(frames, replace(exposures, views=wide), held_out, scan.provenance | {"stitched": "opposite frames"})


@checked_dataclass
class Tube:
    """A round tube about the rotation axis. inner, outer: diameters [m]; attenuation: µ of its wall [1/m]."""

    inner: float
    outer: float
    attenuation: float

    def __post_init__(self) -> None:
        good = 0 <= self.inner < self.outer < math.inf and 0 < self.attenuation < math.inf
        require(
            good,
            "a tube must have an inner diameter from 0, a greater outer one and a positive attenuation, but they are "
            f"{self.inner:g} m, {self.outer:g} m and {self.attenuation:g} per metre; correct --tube.",
        )

    @classmethod
    def parsed(cls, text: str) -> Tube:
        """The tube that INNER:OUTER:ATTENUATION says. Errors: `InputError` for anything else."""
        numbers = [number_in(word) for word in text.split(":")]
        require(
            len(numbers) == 3 and not any(map(math.isnan, numbers)),
            f"--tube must be INNER:OUTER:ATTENUATION, diameters [m] and µ of the wall [1/m], but it is {shown(text)}; "
            "write, for instance, 4e-3:4.5e-3:200.",
        )
        return cls(*numbers)

    def transmission(self, views: Views) -> np.ndarray:
        """Share of the light [V, W] that passes the wall, by column: `exp(-µ t)`, t the wall's length along the ray.

        Of pixels as points; waves that its edges throw, `W` columns wide, are not in it. Errors: `InputError` for views
        without a common axis.
        """
        require(views.shares_axis, "--tube goes with views about one axis, but these turn about others; leave it.")
        columns = (np.arange(views.shape[1]) - 0.5 * (views.shape[1] - 1)) * views.pixel_size
        x = columns + views.shifts[:, :1]
        outer, inner = (2 * np.sqrt(np.maximum((d / 2) ** 2 - x**2, 0)) for d in (self.outer, self.inner))
        return np.exp(-self.attenuation * (outer - inner))

    def taken_out_of(self, scan: Scan) -> Scan:
        """The scan as if without the tube, whose light is divided out of every frame."""
        said = {"tube": f"{self.inner:g} m to {self.outer:g} m, {self.attenuation:g} per metre, divided out"}
        return scan.divided(self.transmission(scan.views)[:, None, :].astype(np.float32), said)
