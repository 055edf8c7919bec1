"""Flats and darks that are unlike the others of their kind: a dark with the beam on, a flat with the sample in it."""

from __future__ import annotations

import numpy as np

SIDE = 64
"""Frames are compared on about so many rows and columns."""
UNLIKE = 0.05
"""Part of the light by which a frame must be off (rms) to be unlike the others."""
TIMES = 5.0
"""So many times more than the others it must be off, too."""
DIM = 10.0
"""A flat of so many times less light than the others, or more, is none."""


def thumbnail(frame: np.ndarray) -> np.ndarray:
    """A frame [H, W] averaged over blocks of pixels to about `SIDE` rows and columns."""
    (h, w), step = frame.shape, [max(1, n // SIDE) for n in frame.shape]
    rows, columns = (n // s for n, s in zip((h, w), step))
    whole = frame[: rows * step[0], : columns * step[1]]
    return whole.reshape(rows, step[0], columns, step[1]).mean(axis=(1, 3))


def odd_darks(darks: np.ndarray, light: float) -> np.ndarray:
    """[n] bool: which of the darks [n, h, w] are unlike the others; light: counts of the flats above the darks.

    Of two that differ, both.
    """
    return _unlike(darks, UNLIKE * light) if light > 0 else np.zeros(len(darks), dtype=bool)


def odd_flats(flats: np.ndarray) -> np.ndarray:
    """[n] bool: which of the flats [n, h, w], less the dark, are unlike the others but for their brightness.

    Of two of which one has no light, both.
    """
    levels = flats.mean(axis=(1, 2))
    usual = float(np.median(levels)) if len(flats) else 0.0
    if usual <= 0:
        return np.zeros(len(flats), dtype=bool)
    odd = (levels < usual / DIM) | (levels > DIM * usual)
    if len(flats) == 2:
        return np.full(2, bool(levels.min() < levels.max() / DIM))
    odd[~odd] = _unlike(flats[~odd] / levels[~odd, None, None], UNLIKE)
    return odd


def _unlike(frames: np.ndarray, least: float) -> np.ndarray:
    """[n] bool: which frames are off the median frame by more than `least`, and than `TIMES` as much as the others."""
    if len(frames) < 2:
        return np.zeros(len(frames), dtype=bool)
    off = np.sqrt(((frames - np.median(frames, axis=0)) ** 2).mean(axis=(1, 2)))
    return off > (least if len(frames) == 2 else max(least, TIMES * float(np.median(off))))
