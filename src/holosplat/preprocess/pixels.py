"""Flat-fielding; defective pixels, found in dark and flat frames and filled from their neighbours; frames of the wrong
kind, such as a flat with the sample in it; rings, faults that stay in their pixels in all projections."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING

import numpy as np

from ..checks import require, shaped, warn
from ..frames import Taken

if TYPE_CHECKING:
    from scipy.sparse import csr_array


def relative_intensity(raw: np.ndarray, dark: np.ndarray | float, light: np.ndarray | float) -> np.ndarray:
    """(raw - dark) / light: counts relative to the same light without an object, float64; light: flat less dark field,
    positive."""
    return (raw - dark) / light


def unlit(light: np.ndarray) -> np.ndarray:
    """Find pixels whose flat field less its dark field is not positive."""
    return ~(light > 0)


def mean_frame(frames: Iterable[np.ndarray], shape: tuple[int, int]) -> np.ndarray:
    """The mean [H, W] of `frames`, float64, one at a time; zeros where there are none."""
    total, count = np.zeros(shape), 0
    for frame in frames:
        total += frame
        count += 1
    return total / max(count, 1)


def fixed_background(counts: np.ndarray) -> np.ndarray:
    """[..., H, W], at least 1: the mode over the times of the counts [T, ..., H, W] of each pixel.

    What moves passes a pixel at few times, so that the mode is the light without it; a mean would keep a part. The
    mode is the mean of the half of the counts that lie closest together (Robertson & Cryer 1974): of some 30 times,
    noise draws the most frequent count.
    """
    counts = np.asarray(counts)
    ordered = np.sort(counts, axis=0).astype(np.float64)
    half = (len(ordered) + 1) // 2
    widths = ordered[half - 1 :] - ordered[: len(ordered) - half + 1]
    first = widths.argmin(axis=0)[None]
    inside = np.arange(len(ordered)).reshape(-1, *(1,) * (counts.ndim - 1))
    kept = (inside >= first) & (inside < first + half)
    return np.maximum((ordered * kept).sum(axis=0) / half, 1.0)


NEIGHBOURHOOD = 5
"""Edge of the window that gives the usual level of a pixel."""
RESPONSE_RANGE = (1 / 3, 3.0)
"""A pixel whose flat, less its dark, is not within these multiples of its neighbours' is defective."""
OUTLIER = 12.0
"""So is one whose dark, or the noise of it, is so many robust standard deviations off its neighbours'."""
LEAST_COUNTS = 1.0
MOST_DEFECTS = 0.2
"""A larger share of defective pixels is no camera to reconstruct from."""
FILLED = "are filled from their neighbours, and have no weight"
"""End of warnings about pixels that have no value of their own."""
NORMAL_MEDIAN = 0.6745
"""The median of |x| for a standard normal x."""
FEWEST_IN_RINGS = 8
"""Projections that must be there, or too much of the object would pass for what all have in common."""
WIDEST_RING = 31
"""Columns of a line that may be taken for a fault, at most."""
DARKEST = 0.01
"""Relative intensity below which a pixel counts as so bright: its logarithm has no meaning."""


def defective_pixels(dark: np.ndarray, dark_noise: np.ndarray, flat: np.ndarray) -> np.ndarray:
    """[H, W] bool: pixels that do not do as their neighbours do.

    dark, flat: mean frames [H, W] [counts]; dark_noise: standard deviations [H, W] over the dark frames [counts],
    zeros where there are too few.
    """
    from scipy.ndimage import median_filter  # which takes long to load

    light = flat - dark
    usual = median_filter(light, NEIGHBOURHOOD, mode="mirror")
    low, high = RESPONSE_RANGE
    bad = ~(light > 0) | (light < low * usual) | (light > high * usual)
    for image in (dark, dark_noise):
        off = image - median_filter(image, NEIGHBOURHOOD, mode="mirror")
        usual_off = max(float(np.median(np.abs(off))) / NORMAL_MEDIAN, LEAST_COUNTS / OUTLIER)
        bad |= off > OUTLIER * usual_off
    return bad


class PixelRepair:
    """Fills the pixels of a mask [H, W] with the mean of their good neighbours, of the nearest ring that has any."""

    def __init__(self, mask: np.ndarray) -> None:
        shaped("pixel mask", mask, (None, None))
        require(not bool(mask.all()), "every pixel is defective; check the mask and the flat frames.")
        self.mask = np.asarray(mask, dtype=bool)
        self.places = np.flatnonzero(self.mask)
        self._means = self._neighbours()

    def __len__(self) -> int:
        return len(self.places)

    def __call__(self, frame: np.ndarray) -> np.ndarray:
        """A copy of `frame` [H, W], float64, with its defective pixels filled."""
        repaired = np.array(frame, dtype=np.float64)
        repaired.reshape(-1)[self.places] = self.values(repaired)
        return repaired

    def values(self, frame: np.ndarray) -> np.ndarray:
        """The values that fill the defective pixels of `frame` [H, W], [B] in raster order."""
        return self._means @ np.asarray(frame, dtype=np.float64).reshape(-1)

    def _neighbours(self) -> csr_array:
        """The sparse matrix [B, H·W] that takes a frame to the means."""
        from scipy.sparse import csr_array  # which takes long to load

        h, w = self.mask.shape
        rows, columns, entries = [], [], []
        for number, place in enumerate(self.places):
            i, j = divmod(int(place), w)
            for radius in range(1, max(h, w)):
                top, left = max(i - radius, 0), max(j - radius, 0)
                good = np.argwhere(~self.mask[top : i + radius + 1, left : j + radius + 1]) + (top, left)
                if len(good):
                    rows += [number] * len(good)
                    columns += (good @ (w, 1)).tolist()
                    entries += [1 / len(good)] * len(good)
                    break
        return csr_array((entries, (rows, columns)), shape=(len(self.places), h * w))


def lit(label: str, light: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Flat fields less dark ones [..., H, W], 1 where they are not positive or NaN (saturated), and the
    `mask` [..., H, W] of defective pixels with these.

    A warning gives their number. Errors: `InputError` for more than a part `MOST_DEFECTS` of the pixels.
    """
    dim, none = unlit(light), unlit(light) & ~mask
    require(
        none.mean() <= MOST_DEFECTS,
        f"{label} must have flats that are brighter than its darks, but in {none.mean():.0%} of the pixels they are "
        "not, or saturated; check which frames are flats and which are darks.",
    )
    saturated = none & np.isnan(light)
    for which, why in ((none & ~saturated, "not brighter than the darks"), (saturated, "saturated")):
        if which.any():
            warn(f"{label}: pixels whose flats are {why} ({int(which.sum())}) {FILLED}")
    return np.where(dim, 1.0, light), mask | dim


def filled(label: str, frames: np.ndarray, found: np.ndarray, mask: np.ndarray, numbers: np.ndarray) -> Taken:
    """Frames [K, H, W] whose pixels `found` [K, H, W], and those of the `mask` [H, W] or [K, H, W], are filled from
    their neighbours, and which pixels these are; numbers: [K] of the frames.

    A warning gives the number of those found. Errors: `InputError` for a frame with more than a part `MOST_DEFECTS`.
    """
    if found.any():
        shares, count = found.mean(axis=(1, 2)), int(found.any(axis=(1, 2)).sum())
        worst = int(np.argmax(shares))
        require(
            shares[worst] <= MOST_DEFECTS,
            f"{label} must hold relative intensities, finite and above 0, but {shares[worst]:.0%} of frame "
            f"{numbers[worst]} are not, or saturated; correct the frames by their flats and darks, crop them, or leave "
            "this one out.",
        )
        which = f"{int(found.sum())} in {count} of {len(frames)} frames"
        warn(f"{label}: pixels that are not above 0, no numbers or saturated ({which}) {FILLED}")
    missing = found | mask
    if not missing.any():
        return frames, None
    repair = PixelRepair(missing[0])
    for i, each in enumerate(missing):
        if each.any():
            repair = repair if np.array_equal(repair.mask, each) else PixelRepair(each)
            frames[i] = repair(frames[i])
    return frames, missing


SIDE = 64
"""Frames are compared on about so many rows and columns."""
UNLIKE = 0.05
"""Part of the light by which a frame must be off (rms) to be unlike the others."""
TIMES = 5.0
"""So many times more than the others it must be off, too."""
DIM = 10.0
"""A flat of so many times less light than the others, or more, is none; a projection of so many times less, neither."""


def thumbnail(frame: np.ndarray) -> np.ndarray:
    """A frame [H, W] averaged over blocks to about `SIDE` rows and columns; a few NaN do not count."""
    bad = ~np.isfinite(frame)
    if 0 < bad.mean() <= MOST_DEFECTS:
        frame = np.where(bad, np.median(frame[~bad]), frame)
    (h, w), step = frame.shape, [max(1, n // SIDE) for n in frame.shape]
    rows, columns = (n // s for n, s in zip((h, w), step))
    top, left = (h - rows * step[0]) // 2, (w - columns * step[1]) // 2
    whole = frame[top : top + rows * step[0], left : left + columns * step[1]]
    return whole.reshape(rows, step[0], columns, step[1]).mean(axis=(1, 3))


def odd_darks(darks: np.ndarray, lit: float) -> np.ndarray:
    """[n] bool: which of the darks [n, h, w] are nearer to the flats' counts (`lit`) than to the darkest one, or unlike
    the others; of two that differ, both."""
    levels = darks.mean(axis=(1, 2))
    bright = levels >= 0.5 * (levels.min() + lit)
    light = lit - float(np.median(levels[~bright])) if not bright.all() else 0.0
    odd = bright | ~np.isfinite(levels)
    if light > 0:
        odd[~odd] = _unlike(darks[~odd], UNLIKE * light)
    return np.full(2, True) if len(odd) == 2 and odd.any() else odd


def odd_flats(flats: np.ndarray) -> np.ndarray:
    """[n] bool: which of the flats [n, h, w], less the dark, have another pattern than the others; of two of which one
    has no light, both."""
    levels = flats.mean(axis=(1, 2))
    finite = levels[np.isfinite(levels)]
    usual = float(np.median(finite)) if len(finite) else 0.0
    if usual < finite.max(initial=0.0) / DIM**2:  # most have no light
        usual = float(finite.max(initial=0.0))
    if usual <= 0:
        return np.zeros(len(flats), dtype=bool)
    odd = (levels < usual / DIM) | (levels > DIM * usual) | ~np.isfinite(levels)
    if len(flats) == 2 and np.isfinite(levels).all():
        return np.full(2, bool(levels.min() < levels.max() / DIM))
    odd[~odd] = _unlike(flats[~odd] / levels[~odd, None, None], UNLIKE)
    return odd


def odd_brightness(flats: np.ndarray) -> np.ndarray:
    """[n] float: the light of flats [n, h, w], less the dark, over their median; 1 for usual ones."""
    levels = flats.mean(axis=(1, 2))
    levels = levels / np.median(levels) if len(levels) and np.median(levels) > 0 else np.ones(len(levels))
    return np.where(_unlike(levels[:, None, None], UNLIKE), levels, 1.0)


def faintly_odd(flats: np.ndarray) -> np.ndarray:
    """[n] float: by what part of the light (rms) each of the flats [n, h, w], less the dark, differs from the others in
    its pattern beyond noise, 0 where that is not `TIMES` more than for the others; two do not tell."""
    levels = flats.mean(axis=(1, 2))
    if len(flats) < 3 or not (levels > 0).all():
        return np.zeros(len(flats))
    relative = flats / levels[:, None, None]
    usual = np.median(relative, axis=0)
    off = np.array([level_and_pattern(frame)[1] for frame in 1 + relative - usual])
    return np.where(off > TIMES * np.median(off), off, 0.0)


def level_and_pattern(frame: np.ndarray) -> tuple[float, float]:
    """The mean of a relative frame [h, w], and how much it varies beyond its noise (rms, in units of the mean), or as
    much as noise hides; the finest diagonal wavelets tell the noise."""
    finest = 0.5 * (frame[:-1, :-1] + frame[1:, 1:] - frame[:-1, 1:] - frame[1:, :-1])
    noise = float((finest**2).mean()) if finest.size else 0.0
    level, power = float(frame.mean()), max(float(frame.var()) - noise, 2 * noise / np.sqrt(frame.size))
    return level, float(np.sqrt(power)) / (level if level > 0 else 1.0)


def dark_or_empty(levels: np.ndarray, patterns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """[n] bool: which frames have no light beside the others, and which show no matter: as bright as the others at
    least, with a pattern `TIMES` weaker. levels, patterns: [n] as of `level_and_pattern`."""
    usual = float(np.median(levels))
    if len(levels) < 3 or usual <= 0:
        return np.zeros(len(levels), dtype=bool), np.zeros(len(levels), dtype=bool)
    dark = levels < usual / DIM
    return dark, (TIMES * patterns < np.median(patterns)) & (levels >= usual)


def _unlike(frames: np.ndarray, least: float) -> np.ndarray:
    """[n] bool: which frames are off the median frame by more than `least`, and than `TIMES` as much as the others."""
    if len(frames) < 2:
        return np.zeros(len(frames), dtype=bool)
    off = np.sqrt(((frames - np.median(frames, axis=0)) ** 2).mean(axis=(1, 2)))
    return off > (least if len(frames) == 2 else max(least, TIMES * float(np.median(off))))


def fixed_pattern(frame: Callable[[int], np.ndarray], count: int, width: int) -> np.ndarray:
    """The factor [H, W], about 1, that all of `count` projections have in common in details finer than `width` columns.

    It is the exponential of the mean of `ln I - median(ln I)`, the median over `width` columns: what turns with the
    object is in other columns in every projection, and averages out; lines of the object along its own axis of rotation
    do not, and are taken for faults, too. So is done row by row in sinograms as in "ring removal" (Boin & Haibel 2006),
    here in relative frames [H, W], `frame(i)`, read one at a time. Errors: `InputError` for fewer than
    `FEWEST_IN_RINGS` projections, or a width that is not odd or beyond 3 to `WIDEST_RING`.
    """
    from scipy.ndimage import median_filter  # which takes long to load

    require(
        3 <= width <= WIDEST_RING and width % 2 == 1,
        f"rings must be an odd number of columns from 3 to {WIDEST_RING}, but it is {width}; take 5.",
    )
    require(
        count >= FEWEST_IN_RINGS,
        f"rings need at least {FEWEST_IN_RINGS} projections, but there are {count}; leave --rings.",
    )
    total = np.zeros(())
    for i in range(count):
        logarithm = np.log(np.maximum(frame(i), DARKEST))
        total = total + (logarithm - median_filter(logarithm, (1, width), mode="nearest"))
    return np.exp(total / count)
