"""Frames of the wrong kind: a dark with the beam on, a flat with the sample in it, a projection without light or
without the sample."""

from __future__ import annotations

import numpy as np

from .pixels import MOST_DEFECTS

SIDE = 64
"""Frames are compared on about so many rows and columns."""
UNLIKE = 0.05
"""Part of the light by which a frame must be off (rms) to be unlike the others."""
TIMES = 5.0
"""So many times more than the others it must be off, too."""
DIM = 10.0
"""A flat of so many times less light than the others, or more, is none; a projection of so many times less, neither."""


def thumbnail(frame: np.ndarray) -> np.ndarray:
    """The middle of a frame [H, W], averaged over blocks of pixels to about `SIDE` rows and columns; few pixels that
    are no numbers do not count."""
    bad = ~np.isfinite(frame)
    if 0 < bad.mean() <= MOST_DEFECTS:
        frame = np.where(bad, np.median(frame[~bad]), frame)
    (h, w), step = frame.shape, [max(1, n // SIDE) for n in frame.shape]
    rows, columns = (n // s for n, s in zip((h, w), step))
    top, left = (h - rows * step[0]) // 2, (w - columns * step[1]) // 2
    whole = frame[top : top + rows * step[0], left : left + columns * step[1]]
    return whole.reshape(rows, step[0], columns, step[1]).mean(axis=(1, 3))


def odd_darks(darks: np.ndarray, lit: float) -> np.ndarray:
    """[n] bool: which of the darks [n, h, w] are nearer to the counts of the flats (`lit`) than to those of the darkest
    one, or else unlike the others.

    Of two that differ, both.
    """
    levels = darks.mean(axis=(1, 2))
    bright = levels >= 0.5 * (levels.min() + lit)
    light = lit - float(np.median(levels[~bright])) if not bright.all() else 0.0
    odd = bright | ~np.isfinite(levels)
    if light > 0:
        odd[~odd] = _unlike(darks[~odd], UNLIKE * light)
    return np.full(2, True) if len(odd) == 2 and odd.any() else odd


def odd_flats(flats: np.ndarray) -> np.ndarray:
    """[n] bool: which of the flats [n, h, w], less the dark, are unlike the others but for their brightness.

    Of two of which one has no light, both.
    """
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
    """[n] float: the light of each of the flats [n, h, w], less the dark, in units of their median, 1 for those that
    are as bright as the others."""
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
    """The mean of a relative frame [h, w], and how much it varies beyond its noise (rms, in units of the mean), or else
    as much as the noise hides.

    The finest diagonal wavelets tell the noise.
    """
    finest = 0.5 * (frame[:-1, :-1] + frame[1:, 1:] - frame[:-1, 1:] - frame[1:, :-1])
    noise = float((finest**2).mean()) if finest.size else 0.0
    level, power = float(frame.mean()), max(float(frame.var()) - noise, 2 * noise / np.sqrt(frame.size))
    return level, float(np.sqrt(power)) / (level if level > 0 else 1.0)


def dark_or_empty(levels: np.ndarray, patterns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """[n] bool: which frames have no light beside the others, and which show no matter, where the others do.

    levels, patterns: [n] as of `level_and_pattern`. Frames without matter are as bright as the others at least, and
    their pattern is `TIMES` weaker.
    """
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
