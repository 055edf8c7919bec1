"""Detection of air: pixels without matter and without its fringes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import numpy as np
import torch
from scipy.ndimage import binary_dilation, gaussian_filter, label
from torch import Tensor

from ..checks import InputError, require

FINE, COARSE = 1.0, 3.0
"""Standard deviations [pixels] of the two blurs whose difference shows fringes and edges, but not slow changes of the
light."""
WINDOW = 3.0
"""Standard deviation of the window in which their power is averaged [pixels]."""
WHITE_POWER = 0.0585
"""This power of white noise of variance one."""
QUIET, QUIET_POWER = 0.1, 0.62
"""The quantile of the power that is believed to be noise, and its ratio to the mean power of noise, white or grain of
one pixel (measured on frames of 96²)."""
CAP = 10.0
"""Power counts up to so many times the noise's: an edge of metal does not hide the air far beside it."""
ROUNDED = 1e-10
"""Noise has this part of the largest power at least: simulated air may be even to the last digit, and without noise at
all the strongest fringe would not stand out."""
ACTIVE = 2.2
"""From so many times the noise's power on there are fringes; noise has as much in two pixels of a thousand."""
MARGIN = 3
"""How far from fringes air begins [pixels]."""
SMALLEST = 0.005
"""Patches of air smaller than this part of a frame are none."""
BRIGHT, DARKER = 0.9, 0.85
"""The quantile of the brightness that is light without matter, and the part of it below which there is matter."""
BRIGHT_BESIDE = 0.75
"""The same at the left and right border, if that is less: broad fringes are brighter than air, and there are fewer."""
NOISE_LIKE, FAINT = 30.0, 0.01
"""The quietest parts are noise if their power is less than so many times that of white noise as strong as their finest
wavelets, or less than that part of the frame's mean power; else fringes fill the frame."""
FEWEST, SMALLEST_FRAME = 5, 900
"""Rows and columns, and pixels, that a frame must have to tell quiet from noisy parts: eight windows."""
LEAST_AIR = 0.03
"""Part of a frame that must be air, or there is none to go by."""

Box = tuple[int, int, int, int]
"""First row, end row, first column, end column of a patch of air [pixels]; the ends are not in it."""


def find_air(frames: Tensor) -> Tensor:
    """Find the air in frames [V, H, W]: [V, H, W] bool, all False in a frame that is too crowded.

    Air is quiet: the power between two scales of blur is that of the frame's quietest parts. It reaches the left or
    the right border, where the inside of a smooth body does not, and it is about as bright as the frame is anywhere.
    The frames need not be normalised, and the light may change slowly across them. Frames of fewer than `FEWEST` rows
    or columns, or of fewer than `SMALLEST_FRAME` pixels, have none. Pixels that are NaN have no value: they have no
    weight, and are no air.
    """
    return torch.from_numpy(np.stack([_air(frame) for frame in frames.detach().cpu().double().numpy()]))


def air_in_boxes(boxes: Sequence[Box], count: int, shape: tuple[int, int]) -> Tensor:
    """Air [V, H, W] bool in all of `count` frames of `shape`, given as boxes; `InputError` for boxes outside."""
    inside = torch.zeros(shape, dtype=torch.bool)
    require(len(boxes) > 0, "air needs at least one box: first row, end row, first column, end column.")
    for top, bottom, left, right in boxes:
        fits = 0 <= top < bottom <= shape[0] and 0 <= left < right <= shape[1]
        if not fits:
            raise InputError(
                f"a box of --air must lie within {shape[0]} rows and {shape[1]} columns, its ends after its "
                f"beginnings, but it is rows {top} to {bottom}, columns {left} to {right}; correct it."
            )
        inside[top:bottom, left:right] = True
    return inside.expand(count, *shape).clone()


def has_air(air: Tensor) -> Tensor:
    """Whether each frame has enough air [V, H, W] to go by, [V] bool."""
    return air.double().mean(dim=(1, 2)) >= LEAST_AIR


def _air(frame: np.ndarray) -> np.ndarray:
    known = np.isfinite(frame)
    if not known[:, [0, -1]].any(axis=0).all() and known.any():  # borders are those of what has a value
        first, last = np.flatnonzero(known.any(axis=0))[[0, -1]]
        return np.pad(_air(frame[:, first : last + 1]), ((0, 0), (first, frame.shape[1] - 1 - last)))
    weights = {width: gaussian_filter(known.astype(float), width, mode="nearest") for width in (FINE, COARSE, WINDOW)}

    def blurred(image: np.ndarray, width: float) -> np.ndarray:
        if known.all():
            return gaussian_filter(image, width, mode="nearest")
        sums = gaussian_filter(np.where(known, image, 0.0), width, mode="nearest")
        return sums / np.maximum(weights[width], np.finfo(float).tiny)

    level = float(np.median(frame[known])) if known.any() else 0.0
    if min(frame.shape) < FEWEST or frame.size < SMALLEST_FRAME or level <= 0:
        return np.zeros(frame.shape, dtype=bool)
    power = (blurred(frame, FINE) - blurred(frame, COARSE)) ** 2
    smooth, sides = blurred(frame, WINDOW), known[:, [0, -1]]
    beside = np.quantile(smooth[:, [0, -1]][sides], BRIGHT_BESIDE)
    bright = ~known | (smooth >= DARKER * min(np.quantile(smooth[known], BRIGHT), beside))
    unbound = blurred(power, WINDOW)
    limit = float(np.quantile(unbound[bright & known], QUIET))
    noise = max(limit / QUIET_POWER, ROUNDED * float(power[known].max()))
    found = np.zeros(frame.shape, dtype=bool)
    quiet = _finest(frame / level)[(unbound <= limit)[:-1, :-1]]
    fine = WHITE_POWER * float(np.nanmean(quiet)) if np.isfinite(quiet).any() else 0.0
    if noise > max(NOISE_LIKE * fine, FAINT * float(power[known].mean())):
        return found
    activity = blurred(np.minimum(power, CAP * noise), WINDOW)
    fringes = np.asarray(binary_dilation(activity > ACTIVE * noise, iterations=MARGIN), dtype=bool)
    patches, count = cast(tuple[np.ndarray, int], label(bright & ~fringes))
    sizes = np.bincount(patches[known], minlength=count + 1) / frame.size
    beside = np.unique(patches[:, [0, -1]])
    found = known & np.isin(patches, [n for n in beside if n > 0 and sizes[n] >= SMALLEST])
    return found if found.mean() >= LEAST_AIR else np.zeros_like(found)


def _finest(frame: np.ndarray) -> np.ndarray:
    """Squares [H - 1, W - 1] of the finest diagonal wavelets, of white noise its variance."""
    return 0.25 * (frame[:-1, :-1] + frame[1:, 1:] - frame[:-1, 1:] - frame[1:, :-1]) ** 2
