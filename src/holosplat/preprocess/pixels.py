"""Defective pixels: found by their levels in dark and flat frames, and filled from their neighbours."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..checks import require, shaped, warn
from ..frames import Taken
from .flat_field import unlit

if TYPE_CHECKING:
    from scipy.sparse import csr_array

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
            warn(f"{label}: {int(which.sum())} pixels whose flats are {why} {FILLED}")
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
        which = f"{int(found.sum())} pixels in {count} of {len(frames)} frames"
        warn(f"{label}: {which} are not above 0, no numbers or saturated; they {FILLED}")
    missing = found | mask
    if not missing.any():
        return frames, None
    repair = PixelRepair(missing[0])
    for i, each in enumerate(missing):
        if each.any():
            repair = repair if np.array_equal(repair.mask, each) else PixelRepair(each)
            frames[i] = repair(frames[i])
    return frames, missing
