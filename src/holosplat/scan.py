"""Everything measured: frames, one exposure per frame, and the split into training and test frames."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from .checks import finite, in_range, require, shaped
from .display import of_scan
from .divided_light import DividedLight
from .frames import Binned, Cropped, Frames, Taken, binned_measured, divided, parts_of, picked
from .geometry import Views
from .units import BEAM_RANGE_KEV
from .volume import Wall

if TYPE_CHECKING:
    from torch import Tensor

ENERGY_RANGE_KEV = (0.1, 1000.0)
PIXEL_RANGE_M = (1e-10, 1e-2)
DISTANCE_RANGE_M = (1e-9, 1e4)
MOST_BLUR_PX = 1000.0
"""Blur beyond which a frame is one grey."""
MOST_BANDWIDTH = 0.5
PER_FRAME = ("energy_kev", "distance", "psf_sigma_px", "time", "bandwidth")
"""Limits of a distance [m] that is not zero; at 0, in contact, there is absorption alone."""


@dataclass(frozen=True)
class Exposures:
    """The conditions of N frames: poses and raster (`views`), photon energy, distance, blur and time.

    energy_kev: [N] photon energies [keV].
    distance: [N] effective propagation distances [m]; 0: in contact, where absorption alone is seen.
    psf_sigma_px: [N] standard deviations of the Gaussian point-spread function [detector pixels].
    time: [N] seconds since the first frame.
    reference_kev: the energy [keV] for which δ and β of matter are given (None: the energy of the first frame).
    bandwidth: [N] relative full widths at half maximum ΔE/E of a Gaussian spectrum about the energy; 0: one energy.
    wall: what is known to be in the beam beside the object, and is part of every model of the frames (None: nothing).

    A number stands for N equal ones. Errors: `InputError` for numbers out of range.

    Examples:

        >>> import holosplat as hs
        >>> views = hs.Views.evenly_spaced(8, shape=(16, 16), pixel_size=1e-6)
        >>> exposures = hs.Exposures.of(views, energy_kev=20.0, distance=0.05, psf_sigma_px=0.5)
        >>> len(exposures), exposures.reference_energy
        (8, 20.0)
        >>> series = exposures.repeated([0.0, 1e-5, 2e-5])
        >>> series.time[[0, 8, 16]]
        array([0.e+00, 1.e-05, 2.e-05])
    """

    views: Views
    energy_kev: np.ndarray
    distance: np.ndarray
    psf_sigma_px: np.ndarray
    time: np.ndarray
    reference_kev: float | None = None
    bandwidth: np.ndarray = field(default_factory=lambda: np.zeros(()))
    wall: Wall | None = None

    def __post_init__(self) -> None:
        count = len(self.views)
        for size in np.unique(self.views.pixel_sizes):
            in_range("pixel size", float(size), *PIXEL_RANGE_M, unit="metres")
        for name in PER_FRAME:
            array = np.asarray(getattr(self, name), dtype=np.float64)
            array = np.broadcast_to(array if array.size == 1 else shaped(name, array, (count,)), (count,))
            object.__setattr__(self, name, array.copy())
        for energy in (*self.energy_kev, *([] if self.reference_kev is None else [self.reference_kev])):
            in_range("energy", float(energy), *BEAM_RANGE_KEV, unit="keV")
        for z in self.distance:
            checked_distance(float(z))
        finite("psf_sigma_px", self.psf_sigma_px)
        finite("time", self.time)
        for width in np.unique(self.bandwidth[self.bandwidth != 0]):
            in_range("bandwidth", float(width), 1e-9, MOST_BANDWIDTH)
        most = float(self.psf_sigma_px.max(initial=0.0))
        require(bool(np.all(self.psf_sigma_px >= 0)), "psf_sigma_px must not be negative; correct it.")
        require(most <= MOST_BLUR_PX, f"psf_sigma_px must be at most {MOST_BLUR_PX:g}, but it is {most:g}; correct it.")

    @classmethod
    def of(cls, views: Views, energy_kev: float, distance: float, psf_sigma_px: float = 0.0) -> Exposures:
        """Exposures that share one distance [m] and one point-spread function, all at time 0."""
        return cls(views, np.array(energy_kev), np.array(distance), np.array(psf_sigma_px), np.array(0.0))

    def __len__(self) -> int:
        return len(self.views)

    def __getitem__(self, index: np.ndarray | list[int] | slice) -> Exposures:
        return replace(
            self,
            views=self.views[index],
            reference_kev=self.reference_kev if self.has_one_energy else self.reference_energy,
            **{name: getattr(self, name)[index] for name in PER_FRAME},
        )

    @property
    def has_one_energy(self) -> bool:
        """Whether all frames have the same photon energy."""
        return bool((self.energy_kev == self.energy_kev[:1]).all())

    @property
    def optical(self) -> Exposures:
        """The same optics on one raster of the views' pitch p; itself where all pixels are alike.

        Of a pixel `s p` waves know only λz/(s p)²: frames look the same on pixels p at z/s². Where matter is, they
        do not say.
        """
        scales = self.views.relative
        if (scales == 1).all():
            return self
        views = replace(self.views, scales=None)
        return replace(self, views=views, distance=self.distance / scales**2)

    @property
    def reference_energy(self) -> float:
        """The energy [keV] for which δ and β of matter are given: `reference_kev`, or else that of the first frame."""
        return float(self.energy_kev[0]) if self.reference_kev is None else float(self.reference_kev)

    def one_energy(self, user: str) -> float:
        """The photon energy [keV] of all frames; `InputError` says that `user` ("the report") needs one energy."""
        low, high = self.energy_kev.min(), self.energy_kev.max()
        require(
            self.has_one_energy,
            f"{user} needs frames of one photon energy, but theirs go from {low:g} to {high:g} keV; "
            "choose those of one energy.",
        )
        return float(self.energy_kev[0])

    def refraction(self, delta: float, beta: float) -> tuple[np.ndarray, np.ndarray]:
        """δ [N] and β [N] at the frames' energies of matter that has `delta` and `beta` at the reference energy.

        Far from absorption edges (`far_from_edges`).
        """
        factors = far_from_edges(self.energy_kev, self.reference_energy)
        return delta * factors[:, 0], beta * factors[:, 1]

    def repeated(self, times: np.ndarray) -> Exposures:
        """All N exposures at each of `times` [T] seconds: frame `t · N + v` is exposure v at `times[t]`."""
        times = np.asarray(times, dtype=np.float64).reshape(-1)
        index = np.tile(np.arange(len(self)), len(times))
        return replace(self[index], time=np.repeat(times, len(self)))


def checked_distance(distance: float, field: str = "propagation distance") -> float:
    """`distance` [m] if it is 0 (in contact) or within `DISTANCE_RANGE_M`; `InputError` naming `field` otherwise."""
    return 0.0 if distance == 0 else in_range(field, distance, *DISTANCE_RANGE_M, unit="metres")


def far_from_edges(energy_kev: np.ndarray, reference_kev: float) -> np.ndarray:
    """Factors [N, 2] of δ and β at energies [N] over those at a reference energy [keV]: δ ∝ E⁻², β ∝ E⁻⁴.

    The electrons count as free for δ, and photoabsorption falls as E⁻³ per atom, with μ = 2kβ (Als-Nielsen & McMorrow
    2011, *Elements of Modern X-ray Physics*, chapters 1 and 3). It holds far above absorption edges; of a known
    formula `materials.dispersion` has the tables' own values.
    """
    ratio = np.asarray(energy_kev, dtype=np.float64) / reference_kev
    return np.stack((ratio**-2, ratio**-4), axis=-1)


class _FramesInMemory:
    """The attribute `Scan.frames`: an array or `Frames` goes in, the array comes out, read once at first use."""

    def __get__(self, scan: Scan | None, owner: type[Scan] | None = None) -> np.ndarray:
        if scan is None:
            raise AttributeError("frames has no default")  # which a dataclass asks the class for
        if isinstance(scan.source, Frames):
            frames, missing = scan.source.with_missing(np.arange(len(scan.source)))
            object.__setattr__(scan, "source", frames)
            object.__setattr__(scan, "_missing", missing)
        return np.asarray(scan.source)

    def __set__(self, scan: Scan, frames: np.ndarray | Frames) -> None:
        object.__setattr__(scan, "source", frames)


class _MissingInMemory:
    """The attribute `Scan.missing`, which is known once the frames are read."""

    def __get__(self, scan: Scan | None, owner: type[Scan] | None = None) -> np.ndarray | None:
        return None if scan is None or scan.frames is None else scan._missing

    def __set__(self, scan: Scan, missing: np.ndarray | None) -> None:
        object.__setattr__(scan, "_missing", missing)


@dataclass(frozen=True, repr=False, eq=False)
class Scan:
    """The frames of a measurement, and the conditions under which they were taken.

    frames: [N, H, W] float32 intensity relative to the flat field; given as `Frames`, they are read into memory when
    `scan.frames` is first used. `scan.source`, `scan[index]`, `blocks` and scans made from them do not read all frames.
    exposures: pose, photon energy, distance, blur and time of each frame.
    is_test: [N] bool, frames held out of the fit.
    provenance: origin of the scan, as flat text entries.
    light: the uncertainty of smooth light that the frames were divided by; None: unknown.
    missing: [N, H, W] bool, pixels without a value of their own, which `frames` fills from their neighbours, and which
        have no weight in a reconstruction; None: there are none. Frames that are given as `Frames` say it themselves.

    Errors: `InputError` where shapes disagree, and for frames that are not finite.

    Examples:

        >>> import numpy as np
        >>> import holosplat as hs
        >>> views = hs.Views.evenly_spaced(4, shape=(16, 20), pixel_size=1e-6)
        >>> exposures = hs.Exposures.of(views, energy_kev=20.0, distance=0.05)
        >>> frames = np.random.default_rng(0).poisson(1000, (4, 16, 20)) / 1000
        >>> scan = hs.Scan(frames, exposures, is_test=[False, False, False, True])
        >>> scan
        Scan(4 frames of 16 × 20 pixels, 1 of them held out)
        >>> scan.train().frames.shape
        (3, 16, 20)
        >>> scan.binned(2)
        Scan(4 frames of 8 × 10 pixels, 1 of them held out)
    """

    if TYPE_CHECKING:
        frames: np.ndarray
    else:
        frames: np.ndarray = _FramesInMemory()
    exposures: Exposures
    is_test: np.ndarray
    provenance: dict[str, str] = field(default_factory=dict)
    light: DividedLight | None = None
    if TYPE_CHECKING:
        missing: np.ndarray | None = None
    else:
        missing: np.ndarray | None = _MissingInMemory()
    source: np.ndarray | Frames = field(init=False)
    _missing: np.ndarray | None = field(init=False)

    def __post_init__(self) -> None:
        wanted = (len(self.exposures), *self.exposures.views.shape)
        if isinstance(self.source, Frames):
            require(self.source.shape == wanted, f"frames must have the shape {wanted}, but it is {self.source.shape}.")
        else:
            require(not np.iscomplexobj(self.source), "frames must be intensities, but they are complex; square them.")
            frames = shaped("frames", np.ascontiguousarray(self.source, dtype=np.float32), wanted)
            object.__setattr__(self, "source", finite("frames", frames))
            if self._missing is not None:
                self.__dict__["_missing"] = shaped("missing", np.asarray(self._missing, dtype=bool), wanted)
        fits = self.light is None or len(self.light) == len(self.exposures)
        require(fits, f"a scan of {wanted[0]} frames needs light of as many, but has {len(self.light or ())}.")
        is_test = shaped("split", np.asarray(self.is_test, dtype=bool), wanted[:1])
        object.__setattr__(self, "is_test", is_test)

    @classmethod
    def of(
        cls,
        frames: np.ndarray | Frames,
        exposures: Exposures,
        is_test: np.ndarray,
        provenance: dict[str, str],
        light: DividedLight | None = None,
        missing: np.ndarray | None = None,
    ) -> Scan:
        """A scan of frames [N, H, W], an array or such as are read when they are asked for."""
        # `_FramesInMemory` takes both
        return cls(frames, exposures, is_test, provenance, light, missing)  # type: ignore[arg-type]

    def taken(self, exposures: Exposures, said: dict[str, str] | None = None) -> Scan:
        """The same frames with other exposures, and what is said of these."""
        return Scan.of(self.source, exposures, self.is_test, self.provenance | (said or {}), self.light, self._missing)

    def __len__(self) -> int:
        return len(self.source)

    def __repr__(self) -> str:
        h, w = self.views.shape
        return f"Scan({len(self)} frames of {h} × {w} pixels, {int(self.is_test.sum())} of them held out)"

    _repr_html_ = of_scan

    def __getitem__(self, index: np.ndarray | list[int] | slice) -> Scan:
        frames = picked(self.source, index)
        light = None if self.light is None else self.light[index]
        missing = None if self._missing is None else self._missing[index]
        return Scan.of(frames, self.exposures[index], self.is_test[index], self.provenance, light, missing)

    def in_memory(self) -> Scan:
        """This scan with all its frames read, where bad ones are named: for who uses each of them, more than once."""
        return Scan.of(self.frames, self.exposures, self.is_test, self.provenance, self.light, self.missing)

    def blocks(self) -> Iterator[np.ndarray]:
        """All frames in turn, some at once, [K, H, W] float32: a few of a long series are in memory at a time."""
        return (frames for frames, _ in self.blocks_with_missing())

    def blocks_with_missing(self) -> Iterator[Taken]:
        """The same with the pixels [K, H, W] bool that are `missing`."""
        for part in parts_of(self.source, len(self)):
            if isinstance(self.source, Frames):
                yield self.source.with_missing(np.arange(len(self))[part])
            else:
                yield self.source[part], None if self._missing is None else self._missing[part]

    @property
    def gaps(self) -> Tensor | None:
        """The `missing` pixels as a tensor, for those who retrieve and fit."""
        import torch  # which a scan is read without

        return None if self.missing is None else torch.from_numpy(self.missing)

    @property
    def measured(self) -> Tensor:
        """The frames [N, H, W] as a tensor, NaN in missing pixels: for estimates of noise and light."""
        import torch

        return self.known(torch.from_numpy(self.frames))

    def known(self, images: Tensor) -> Tensor:
        """Images [N, H, W] of the frames' pixels, NaN in missing ones."""
        return images if self.gaps is None else images.masked_fill(self.gaps, float("nan"))

    def left(self, predicted: Tensor) -> Tensor:
        """The frames [N, H, W] less those predicted, 0 in missing pixels."""
        measured = self.measured
        return (measured - predicted).masked_fill(measured.isnan(), 0.0)

    @property
    def views(self) -> Views:
        """The exposures' poses and raster."""
        return self.exposures.views

    @property
    def instants(self) -> np.ndarray:
        """The distinct times [T] of the frames [s], in order."""
        return np.unique(self.exposures.time)

    @property
    def is_series(self) -> bool:
        """Whether the frames show a possibly moving object at several times: some are simultaneous, or all have one
        direction.

        Frames of as many times as directions are a scan of one turning object, as in tomography.
        """
        count = len(self.instants)
        one_side = np.allclose(self.views.rotations, self.views.rotations[0], atol=1e-6)
        return count > 1 and (count < len(self) or bool(one_side))

    def at_instant(self, index: int) -> Scan:
        """The frames of the instant `index` (0 is the first), as a scan of a static object: all at time 0."""
        last = len(self.instants) - 1
        require(0 <= index <= last, f"the scan's instants are counted from 0 to {last}, but {index} is asked for.")
        return self[np.flatnonzero(self.exposures.time == self.instants[index])].as_static()

    def as_static(self) -> Scan:
        """All frames as if taken at the same time, 0."""
        return self.taken(replace(self.exposures, time=np.zeros(len(self))))

    def with_views(self, views: Views) -> Scan:
        """The same frames as if taken at other poses."""
        return self.taken(replace(self.exposures, views=views))

    def divided(self, light: np.ndarray, said: dict[str, str]) -> Scan:
        """The scan over `light`, [1, H, W] for all frames or [N, H or 1, W] for each, with `said` of it."""
        frames = divided(self.source, light)
        return Scan.of(frames, self.exposures, self.is_test, self.provenance | said, self.light, self._missing)

    def with_split(self, is_test: np.ndarray) -> Scan:
        """The scan with the frames `is_test` [N] bool held out, and no others."""
        return Scan.of(self.source, self.exposures, is_test, self.provenance, self.light, self._missing)

    def cropped(self, rows: slice, columns: slice) -> Scan:
        """The scan on the rows and columns from `start` to `stop` (pixels); the detector's shifts say where it lies.

        Errors: `InputError` unless both have a start and a stop within the frames, the start first.
        """
        for name, part, count in zip(("rows", "columns"), (rows, columns), self.views.shape):
            fits = 0 <= part.start < part.stop <= count
            require(fits, f"{name} to keep must be some of 0:{count}, but they are {part.start}:{part.stop}.")
        whole = self.source
        frames = Cropped(whole, rows, columns) if isinstance(whole, Frames) else whole[:, rows, columns]
        exposures = replace(self.exposures, views=self.views.cropped(rows, columns))
        light = self.light and self.light.cropped(rows.start, columns.start)
        missing = None if self._missing is None else self._missing[:, rows, columns]
        return Scan.of(frames, exposures, self.is_test, self.provenance, light, missing)

    def coarsened(self, factor: int) -> Scan:
        """The scan on pixels `factor` times larger, or as large as its rows and columns allow."""
        return self.binned(self.largest_binning(factor))

    def largest_binning(self, factor: int) -> int:
        """`factor`, or the number of rows or of columns where there are fewer: a fan of slices has few rows."""
        return min(factor, *self.views.shape)

    def binned(self, factor: int) -> Scan:
        """The scan on pixels `factor` times larger (means of `factor × factor`); odd rows and columns are cut."""
        if factor == 1:
            return self
        if isinstance(self.source, Frames):
            frames, missing = Binned(self.source, factor), None
        else:
            frames, missing = binned_measured(self.source, self._missing, factor)
        (h, w), (top, left) = frames.shape[1:], ((n % factor) // 2 for n in self.views.shape)
        odd = np.array([self.views.shape[1] - w * factor - 2 * left, self.views.shape[0] - h * factor - 2 * top])
        views = replace(
            self.views,
            shape=(h, w),
            pitch=self.views.pitch * factor,
            shifts=self.views.shifts - 0.5 * odd * self.views.pixel_sizes[:, None],
        )
        exposures = replace(self.exposures, views=views, psf_sigma_px=self.exposures.psf_sigma_px / factor)
        light = self.light and self.light.cropped(top, left).binned(factor)
        return Scan.of(frames, exposures, self.is_test, self.provenance, light, missing)

    def train(self) -> Scan:
        """The training frames only; `InputError` when there are none."""
        require(not self.is_test.all(), "the scan has no training frame: --test-views or /entry/split holds all out.")
        return self[np.flatnonzero(~self.is_test)]

    def test(self) -> Scan:
        """The held-out frames only (possibly none)."""
        return self[np.flatnonzero(self.is_test)]


def interleaved_split(count: int, every: int = 4) -> np.ndarray:
    """[count] bool: True for each `every`-th frame (the last of every group), which is held out; 0 holds out none."""
    return np.arange(count) % max(every, 1) == every - 1
