"""Frames brought from one raster to another as the other raster's pixels would have seen them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
import torch
from scipy.fft import dct, next_fast_len
from scipy.ndimage import gaussian_filter, map_coordinates
from torch import Tensor

from ..checks import positive, shaped

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


def between(images: Tensor, factor: int) -> Tensor:
    """Images [..., H, W] at samples `factor` times as dense, band-limited between those that there are;
    differentiable."""
    if factor == 1:
        return images
    rows, columns = (_denser(n, factor).to(images) for n in images.shape[-2:])
    return rows @ images @ columns.T


@lru_cache(maxsize=8)
def _denser(count: int, factor: int) -> Tensor:
    return torch.from_numpy(_matrix(count, count * factor, 1 / factor))


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


STEPS, NEAR = 12, 1e-3
"""Gauss–Newton steps of a registration at most, and the step [pixels] that ends them."""
BORDER = 16
"""Pixels at the frames' borders that a registration leaves out."""
FOLDS = 8
"""Parts of the frame that are left out in turn: their scatter is the standard error of a registration."""


@dataclass(frozen=True)
class InLine:
    """Cameras in one beam. wavelength, pixel: [m]; distances: [C] m along the beam from the plane z = 0 to each camera.

    Only λz and the pixel enter, so light of any wavelength will do. Errors: `InputError` for lengths that are not
    positive.
    """

    wavelength: float
    pixel: float
    distances: Sequence[float]

    def __post_init__(self) -> None:
        for name in ("wavelength", "pixel"):
            positive(name, getattr(self, name), "metres")
        for distance in self.distances:
            positive("distances", distance, "metres")


@dataclass(frozen=True)
class Registration:
    """Where a camera sees what the first one has at (row, column): at `(row, column) + shift + matrix (row, column)`,
    about the frame's centre.

    shift: [2] pixels; matrix: [2, 2]; errors: [6] standard errors of (shift, matrix) by rows; correlation: of both
    images
    """

    shift: np.ndarray
    matrix: np.ndarray
    errors: np.ndarray
    correlation: float

    @property
    def turn(self) -> float:
        """Turn of the camera about the beam [rad]."""
        return 0.5 * float(self.matrix[1, 0] - self.matrix[0, 1])

    @property
    def magnification(self) -> float:
        """Magnification relative to the first camera."""
        return 1 + 0.5 * float(np.trace(self.matrix))

    def error_px(self, shape: tuple[int, int]) -> float:
        """Root-mean-square standard error [pixels] of a place, over both axes and a frame of `shape`."""
        spread = [1.0, *(n**2 / 12 for n in shape)]
        return math.sqrt(sum(float(e) ** 2 * s for e, s in zip(self.errors, 2 * spread)) / 2)

    def applied(self, image: np.ndarray) -> np.ndarray:
        """An image [H, W] of this camera on the first one's raster."""
        return map_coordinates(image, self._places(image.shape), order=3, mode="nearest")

    def _places(self, shape: Sequence[int]) -> np.ndarray:
        """[2, H, W] in this camera."""
        own = _centred(shape)
        centre = 0.5 * (np.array(shape)[:, None, None] - 1)
        return centre + own + self.shift[:, None, None] + np.einsum("ij,jhw->ihw", self.matrix, own)


def _centred(shape: Sequence[int]) -> np.ndarray:
    """[2, H, W]: rows and columns from the frame's centre."""
    return np.stack(np.meshgrid(*(np.arange(n) - 0.5 * (n - 1) for n in shape), indexing="ij"))


def register(plates: np.ndarray, optics: InLine, blur_px: float = 1.5) -> list[Registration]:
    """The registration of each further camera, from `plates` [C, H, W] of one flat plate at z = 0 in all cameras.

    Each image is refocused to the plate by its camera's distance. The first place is the peak of the correlation; then
    shift, matrix, gain and level follow by least squares (Lucas & Kanade 1981). Eighths of the frame left out in turn
    (jackknife) give the errors. blur_px: standard deviation of the blur before [pixels].
    """
    shaped("plates", plates, (len(optics.distances), *np.shape(plates)[1:]))
    images = []
    for plate, distance in zip(np.asarray(plates, dtype=np.float64), optics.distances):
        even = plate / gaussian_filter(plate, min(plate.shape) / 8)
        sharp = gaussian_filter(np.abs(refocused(even, optics, distance)), blur_px)
        images.append(sharp - gaussian_filter(sharp, 8 * blur_px))
    shape = images[0].shape
    part = np.add.outer(np.arange(shape[0]) // (shape[0] // FOLDS), np.arange(shape[1]) // (shape[1] // FOLDS)) % FOLDS
    found = []
    for image in images[1:]:
        first = _peak(images[0], image)
        whole = _aligned(images[0], image, first, np.zeros((2, 2)), part >= 0)
        kept = [_aligned(images[0], image, whole[0], whole[1], part != fold) for fold in range(FOLDS)]
        numbers = np.array([np.c_[shift, matrix].ravel() for shift, matrix, _ in kept])
        errors = np.sqrt((FOLDS - 1) * numbers.var(axis=0))
        found.append(Registration(whole[0], whole[1], errors, whole[2]))
    return found


def refocused(image: np.ndarray, optics: InLine, distance: float) -> np.ndarray:
    """The wave [H, W] a `distance` [m] before a hologram [H, W] of mean 1, whose phase counts as 0 (Gabor 1948)."""
    import torch  # readers of scans use this module, and need no waves

    from .propagation import fresnel_factors

    margin = [next_fast_len(2 * n) - n for n in image.shape]
    around = np.pad(image - 1, [(m // 2, m - m // 2) for m in margin], mode="symmetric")
    lam_z = torch.tensor([-optics.wavelength * distance], dtype=torch.float64)
    rows, columns = (each[0].numpy() for each in fresnel_factors(around.shape, optics.pixel, lam_z, torch.complex128))
    wave = 1 + np.fft.ifft2(np.fft.fft2(around) * rows[:, None] * columns)
    return wave[tuple(slice(m // 2, m // 2 + n) for m, n in zip(margin, image.shape))]


def _peak(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """[2] whole pixels by which `other` is shifted: the peak of the correlation."""
    window = np.outer(*(np.hanning(n) for n in one.shape))
    product = np.fft.ifft2(np.fft.fft2(one * window).conj() * np.fft.fft2(other * window)).real
    peak = np.unravel_index(product.argmax(), product.shape)
    return np.array([(k + n // 2) % n - n // 2 for k, n in zip(peak, product.shape)], dtype=np.float64)


def _aligned(
    one: np.ndarray, other: np.ndarray, shift: np.ndarray, matrix: np.ndarray, kept: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """Shift, matrix and correlation of `other` upon `one` over the pixels `kept`."""
    kept = kept.copy()
    kept[:BORDER], kept[-BORDER:], kept[:, :BORDER], kept[:, -BORDER:] = (False,) * 4
    own, moved = _centred(one.shape)[:, kept], other
    for _ in range(STEPS):
        moved = Registration(shift, matrix, np.zeros(6), 0.0).applied(other)
        slopes = [slope[kept] for slope in np.gradient(moved)]
        columns = [slope * factor for slope in slopes for factor in (1.0, *own)]
        design = np.stack([*columns, moved[kept], np.ones(kept.sum())], axis=1)
        step = np.linalg.lstsq(design, (one - moved)[kept], rcond=None)[0]
        numbers = (step[:6] / (1 + step[6])).reshape(2, 3)
        shift, matrix = shift + numbers[:, 0], matrix + numbers[:, 1:]
        if np.abs(numbers[:, 0]).max() < NEAR:
            break
    return shift, matrix, float(np.corrcoef(one[kept], moved[kept])[0, 1])
