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
