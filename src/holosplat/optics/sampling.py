"""How finely, and on how large a raster, waves must be sampled."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import torch
from scipy.fft import next_fast_len
from torch import Tensor

from ..geometry import Grid
from ..scan import Exposures
from ..units import wavelength, wavenumber
from .propagation import fresnel_reach_px

FRINGE_SAMPLES = 1.5
"""Wave samples on the first fringe's width √(λz) in reconstructions, and where they are judged: with fewer, the fringes
at the edges of cells are lost (docs/notebook/method.md); more cost memory and time as their square."""
NARROWEST_FRINGE = 1 / 16
"""Pixels on a first fringe below which it needs no samples of its own: light moves by less than a thousandth of a pixel
where the phase changes by one radian a pixel (λz/2πp²)."""
MOST_SAMPLES = 4_000_000
"""Samples of the waves of several views that are worked on at once, where they could follow in turn."""
GUARD_PX = 5
"""Detector pixels of margin beyond the fringes' reach: room for the point-spread function and faint tails."""


def padding(exposures: Exposures, oversample: int) -> tuple[int, int]:
    """Margin (rows, columns) in detector pixels that the fringes need, such that FFT lengths are 5-smooth.

    The margin on each side is at most the field of view; the propagator cuts light that would travel further (see
    `fresnel_transfer`).
    """
    margin = fringe_reach(exposures, oversample) + GUARD_PX
    h, w = exposures.views.shape
    return smooth_margin(h, min(margin, h + GUARD_PX)), smooth_margin(w, min(margin, w + GUARD_PX))


def fringe_reach(exposures: Exposures, oversample: int) -> int:
    """How far [detector pixels] the finest fringes travel and the point-spread function reaches, in any frame."""
    exposures = exposures.optical
    pitch = exposures.views.pixel_size
    optics = zip(exposures.distance, exposures.energy_kev)
    reach = max(fresnel_reach_px(pitch / oversample, z, float(energy)) for z, energy in optics)
    return math.ceil(reach / oversample) + math.ceil(4 * float(exposures.psf_sigma_px.max()))


def fringe_sampling(exposures: Exposures, extra: int = 0, voxels: float = math.inf) -> int:
    """Samples per detector pixel that fits and what judges them work with; extra: further ones, for safety.

    Frames whose first fringe is narrower than `NARROWEST_FRINGE` pixels, or that have none, need one sample a pixel.
    Matter on voxels, so many along a pixel's edge, has nothing finer than these: one sample a voxel shows it, and two a
    pixel the intensities, which have twice the band of waves. More would show the edges of voxels as fringes. Where the
    phase of a known wall jumps by more than half a wave from one pixel to the next, there are twice as many.
    """
    steep = 2 if _is_steep(exposures) else 1
    exposures = exposures.optical
    seen = np.flatnonzero(fringes(exposures) >= NARROWEST_FRINGE * exposures.views.pixel_size)
    finest = resolving_oversample(exposures[seen], FRINGE_SAMPLES, at_least=1) if len(seen) else 1
    return extra + steep * min(finest, max(2, finest if math.isinf(voxels) else math.ceil(voxels)))


def _is_steep(exposures: Exposures) -> bool:
    """Whether samples a pixel apart are too few for the waves behind a known wall (Nyquist)."""
    if exposures.wall is None:
        return False
    one_row = replace(exposures.views, shape=(1, exposures.views.shape[1]))
    phase = exposures.wall.project(one_row)[1] * torch.from_numpy(wavenumber(exposures.energy_kev))[:, None, None]
    return bool(((phase[:, :, 2:] - phase[:, :, :-2]).abs() > np.pi).any())  # a face within a pixel is in two steps


def fringes(exposures: Exposures) -> np.ndarray:
    """Widths √(λz) [V] of the first fringes [m]; 0 in contact."""
    return np.sqrt(wavelength(exposures.energy_kev) * exposures.distance)


def views_seeing(exposures: Exposures, grid: Grid) -> np.ndarray:
    """The number of views that show each voxel, [Z, Y, X] uint16 on `grid`.

    A view shows a voxel if the projection of its centre lies on the frame, and the first fringe around it does, too.
    """
    views, (x, y, z) = exposures.views, grid.axes()
    half = 0.5 * views.fields - fringes(exposures)[:, None]
    found = np.zeros(grid.shape, dtype=np.uint16)
    rows = y[:1] if views.shares_axis else y  # all rows then have the same columns
    for v, (rotation, shift, (width, height)) in enumerate(zip(views.rotations, views.shifts, half)):
        column, row, depth = (a[0] * x + a[1] * rows[:, None] + a[2] * z[:, None, None] for a in rotation)
        larger = 1.0 if views.sources is None else 1 + depth / views.sources[v]
        column, row = column / larger - shift[0], row / larger - shift[1]
        row = y[:, None] - shift[1] if views.shares_axis else row
        found += (np.abs(column) <= width) & (np.abs(row) <= height)
    return found


def resolving_oversample(exposures: Exposures, samples_per_fringe: float, at_least: int) -> int:
    """Samples per detector pixel that put `samples_per_fringe` samples on the first fringe's width √(λz).

    At most `2 samples_per_fringe`, or 8: fringes far narrower than a pixel hardly change a pixel's mean (with 16,
    cells of 64 µm on 3.2 µm pixels stay right to 1.5 % of their contrast however short the distance). In contact there
    is no fringe, and `at_least` is what is taken.
    """
    exposures = exposures.optical
    widths = fringes(exposures)
    if not widths.any():
        return at_least
    wanted = math.ceil(exposures.views.pixel_size * samples_per_fringe / widths[widths > 0].min())
    return max(at_least, min(wanted, max(8, math.ceil(2 * samples_per_fringe))))


def smooth_margin(length: int, margin: int) -> int:
    """The least margin, not below `margin`, with which `length + 2 margin` has no prime factor above 5."""
    while next_fast_len(whole := length + 2 * margin, real=True) != whole:
        margin += 1
    return margin


class SharedPoses:
    """Frames of one projection: those of one pose, pixel, time and photon energy at several distances.

    of: [V] int, the projection of each; any: whether there are such frames. Poses are one whose turn to each other
    moves the edge of the field by less than half a pixel, as of frames that were aligned one by one. Where poses are
    taken at one distance alone, each frame stays by itself. Shifts may differ: `retrieval.contact` moves frames to each
    other.
    """

    def __init__(self, exposures: Exposures) -> None:
        count = len(exposures)
        pose = np.arange(count) if np.ptp(exposures.distance) == 0 else self._poses(exposures)
        frames = np.bincount(pose, minlength=count)
        self.any = bool((frames > 1).any())
        _, of = np.unique(pose, return_inverse=True)
        self.of = of.reshape(-1)
        self._of, self._count = torch.from_numpy(self.of), torch.from_numpy(np.bincount(self.of))

    @staticmethod
    def _poses(exposures: Exposures) -> np.ndarray:
        """The first frame of the pose of each [V]: the nearest pose that has none of its distance yet."""
        views, turns, distance = exposures.views, exposures.views.rotations, exposures.distance.tolist()
        optics = np.stack((views.relative, exposures.time, exposures.energy_kev), axis=1)
        _, kind = np.unique(optics, axis=0, return_inverse=True)
        kind, pose = kind.reshape(-1), np.arange(len(exposures))
        least = 2 * (1 - np.cos(1 / max(views.shape)))  # 3 - trace of a turn of half a pixel at the edge
        order = np.argsort(kind, kind="stable")
        for same in np.split(order, np.flatnonzero(np.diff(kind[order])) + 1):
            firsts: list[int] = []
            has: list[set[float]] = []
            for v in same.tolist():
                far = 3 - np.einsum("nij,ij->n", turns[firsts], turns[v])
                far[[distance[v] in distances for distances in has]] = np.inf
                n = int(far.argmin()) if firsts else 0
                if firsts and far[n] < least:
                    pose[v] = firsts[n]
                    has[n].add(distance[v])
                else:
                    firsts.append(v)
                    has.append({distance[v]})
        return pose

    def sum(self, values: Tensor) -> Tensor:
        """Values [V, ...], each as the sum over the frames of its projection."""
        if not self.any:
            return values
        of = self._of.to(values.device)
        return values.new_zeros(len(self._count), *values.shape[1:]).index_add_(0, of, values).index_select(0, of)

    def mean(self, values: Tensor) -> Tensor:
        """Values [V, ...], each as the mean over the frames of its projection."""
        if not self.any:
            return values
        count = self._count[self._of].reshape(-1, *(1,) * (values.ndim - 1))
        return self.sum(values) / count.to(values)


def alike(exposures: Exposures, oversample: int = 0) -> Iterator[np.ndarray]:
    """Indices of views that share distance, blur and energy, and so a raster, of `MOST_SAMPLES` at most or one by one.

    Frames of one projection (`SharedPoses`) stay together, beside those of others of the same distances.
    oversample: wave samples a pixel (0: as the first fringe needs).
    """
    optical = exposures.optical
    optics = np.stack((optical.distance, optical.psf_sigma_px, optical.energy_kev), axis=1)
    _, kind = np.unique(optics, axis=0, return_inverse=True)
    kind, of = kind.reshape(-1), SharedPoses(exposures).of
    order = np.lexsort((np.arange(len(of)), of))
    poses = np.split(order, np.flatnonzero(np.diff(of[order])) + 1)
    together: dict[tuple[int, ...], list[np.ndarray]] = {}
    for pose in sorted(poses, key=lambda pose: pose[0]):
        together.setdefault(tuple(sorted(kind[pose])), []).append(pose)
    for _, same in sorted(together.items()):
        sample = exposures[same[0]]
        finer = oversample or fringe_sampling(sample)
        rows, columns = sample.views.padded(padding(sample, finer)).refined(finer).shape
        at_once = max(1, MOST_SAMPLES // (rows * columns * len(same[0])))
        yield from (np.concatenate(same[i : i + at_once]) for i in range(0, len(same), at_once))


def on_larger_pixels(exposures: Exposures, binning: int) -> Exposures:
    """The same field on pixels `binning` times larger."""
    if binning == 1:
        return exposures
    views = exposures.views
    shape = (max(1, views.shape[0] // binning), max(1, views.shape[1] // binning))
    views = replace(views, shape=shape, pitch=views.pitch * binning)
    return replace(exposures, views=views, psf_sigma_px=exposures.psf_sigma_px / binning)
