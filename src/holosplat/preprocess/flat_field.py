"""Plain flat-fielding, the arithmetic that reading and correcting scans share."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np


def relative_intensity(raw: np.ndarray, dark: np.ndarray | float, light: np.ndarray | float) -> np.ndarray:
    """(raw - dark) / light: counts relative to the counts of the same light without an object, float64.

    light: flat field less dark field, positive where it is used (see `unlit`).
    """
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
