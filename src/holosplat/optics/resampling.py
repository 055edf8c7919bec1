"""Frames brought from one raster to another as the other raster's pixels would have seen them."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from scipy.fft import dct

from ..checks import positive

Flip = Literal["none", "rows", "columns", "both"]
"""How a beam's optics turn its frames over."""
FLIPS: dict[Flip, tuple[bool, bool]] = {
    "none": (False, False),
    "rows": (True, False),
    "columns": (False, True),
    "both": (True, True),
}
"""For each flip: whether rows, and columns, are read backwards."""


class Resampling:
    """Frames [H, W] of pixels `pixel` [m] brought to `shape` (H', W') pixels of `target` [m] about the same centre.

    Pixels average the intensity over their squares, which in Fourier space is a factor sinc(p f); a frame on coarser
    pixels is that on finer ones times sinc(p' f)/sinc(p f), which also keeps fine fringes from aliasing more than such
    pixels would let them. On finer pixels the coarse ones' blur stays, which `extra_blur` is. Beyond its border
    a frame is mirrored (cosine series), and between samples it is band-limited.
    """

    def __init__(self, source: tuple[int, int], pixel: float, shape: tuple[int, int], target: float) -> None:
        self.shape = shape
        self._ratio = positive("target pixel size", target, "metres") / positive("pixel size", pixel, "metres")
        self._rows, self._columns = (_matrix(n, m, self._ratio) for n, m in zip(source, shape))
        self.extra_blur = math.sqrt(max(pixel**2 - target**2, 0.0) / 12)
        """Standard deviation [m] that the point-spread function of the resampled frames has beside its own."""

    def __call__(self, frame: np.ndarray) -> np.ndarray:
        """The frame [H', W'], float64."""
        return self._rows @ np.asarray(frame, dtype=np.float64) @ self._columns.T


def _matrix(count: int, target: int, ratio: float) -> np.ndarray:
    """[target, count]: the filtered cosine series of `count` samples, at `target` places `ratio` times as far apart."""
    k = np.arange(count)
    frequency = 0.5 * k / count  # cycles a pixel
    kept = np.sinc(frequency * ratio) / np.sinc(frequency) if ratio > 1 else np.ones(count)
    places = 0.5 * count + (np.arange(target) + 0.5 - 0.5 * target) * ratio  # from the border, in pixels
    series = np.cos(np.pi * np.outer(places, k) / count) * kept
    forward = np.asarray(dct(np.eye(count), axis=0)) / count  # of each sample's unit frame
    forward[0] *= 0.5
    return series @ forward
