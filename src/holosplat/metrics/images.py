"""Scores of predicted against measured images: SSIM, PSNR, L1, and the mean Fourier ring correlation.

Intensities are first mapped affinely so that the minimum and maximum over all *training* frames become 0 and
1; nothing is clipped. SSIM, PSNR and L1 are then taken with a data range of 1. FRC does not depend on the
map.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from ..checks import InputError, finite, require, shaped
from .correlation import fourier_ring_correlation, half_bit_threshold, ring_counts, ring_weighted_mean

SSIM_WINDOW = 11
SSIM_SIGMA = 1.5
SSIM_K1, SSIM_K2 = 0.01, 0.03


@dataclass(frozen=True)
class ImageScores:
    """Scores of N predicted images against the measured ones.

    ssim, psnr [dB], l1, frcm: [N] float64.
    data_range: `(low, high)` of the training frames, which the scores of intensity take to 0 and 1.
    frequency: [R] [cycles/pixel].
    frc: [N, R].
    half_bit: [R], the ½-bit threshold.
    """

    ssim: np.ndarray
    psnr: np.ndarray
    l1: np.ndarray
    frcm: np.ndarray
    data_range: tuple[float, float]
    frequency: np.ndarray
    frc: np.ndarray
    half_bit: np.ndarray

    def __len__(self) -> int:
        return len(self.ssim)

    @property
    def mean(self) -> dict[str, float]:
        """Means over the images: `ssim`, `psnr` [dB], `l1`, `frcm`."""
        return {name: float(np.mean(getattr(self, name))) for name in ("ssim", "psnr", "l1", "frcm")}

    def as_dict(self) -> dict:
        """The numbers, ready for JSON: `data_range`, `mean` and `per_frame` (no curves)."""
        names = ("ssim", "psnr", "l1", "frcm")
        return {
            "data_range": list(self.data_range),
            "mean": {name: json_number(value) for name, value in self.mean.items()},
            "per_frame": {name: [json_number(v) for v in getattr(self, name)] for name in names},
        }

    def curves(self) -> dict[str, list]:
        """The curves, ready for JSON: `frequency` [cycles/pixel], `frc` (one list an image), `half_bit`."""
        return {name: getattr(self, name).tolist() for name in ("frequency", "frc", "half_bit")}


def intensity_range(train_frames: np.ndarray) -> tuple[float, float]:
    """`(low, high)`: minimum and maximum over all training frames [N, H, W] (relative intensity).

    Raises `InputError` when there is no frame, a value is not finite, or all values are equal.
    """
    frames = np.asarray(train_frames)
    require(frames.size > 0, "the data range needs at least one training frame, but there is none.")
    finite("training frames", frames)
    low, high = float(frames.min()), float(frames.max())
    require(high > low, f"the training frames hold the single value {low:g}, so they have no data range.")
    return low, high


def image_scores(predicted: np.ndarray, measured: np.ndarray, data_range: tuple[float, float]) -> ImageScores:
    """Scores of `predicted` against `measured` images, both [N, H, W] relative intensity.

    data_range: `(low, high)` from `intensity_range` of the *training* frames. PSNR is infinite for equal
    images. Raises `InputError` when shapes differ, there is no image, a value is not finite, or the range is
    empty.
    """
    first, second = (np.asarray(frames, dtype=np.float64) for frames in (predicted, measured))
    shaped("predicted frames", first, (None, None, None))
    shaped("predicted frames", first, second.shape)
    require(len(first) > 0, "image scores need at least one image, but there is none.")
    finite("predicted frames", first)
    finite("measured frames", second)
    low, high = (float(v) for v in data_range)
    require(high > low, f"data_range must be (low, high) with low < high, but it is {tuple(data_range)}.")
    first, second = ((frames - low) / (high - low) for frames in (first, second))
    curves = [fourier_ring_correlation(a, b) for a, b in zip(first, second)]
    frc = np.stack([curve for _, curve in curves])
    return ImageScores(
        ssim=np.array([structural_similarity(a, b) for a, b in zip(first, second)]),
        psnr=np.array([peak_signal_to_noise(a, b) for a, b in zip(first, second)]),
        l1=np.abs(first - second).mean(axis=(1, 2)),
        frcm=ring_weighted_mean(frc),
        data_range=(low, high),
        frequency=curves[0][0],
        frc=frc,
        half_bit=half_bit_threshold(ring_counts(first.shape[1:])),
    )


def structural_similarity(image_a: np.ndarray, image_b: np.ndarray) -> float:
    """Mean SSIM of two images [H, W] of data range 1 (Wang et al. 2004, eq. 13).

    11 × 11 Gaussian window (a side shorter than that has one window, of its length), σ = 1.5, K₁ = 0.01, K₂ = 0.03.
    Moments are the window's weighted ones (no N/(N-1) correction), and only windows that lie wholly inside the image
    count, as in the authors' own code; that is scikit-image with `gaussian_weights=True, sigma=1.5,
    use_sample_covariance=False, data_range=1`.
    Raises `InputError` for images of different shapes.
    """
    a, b = np.asarray(image_a, dtype=np.float64), np.asarray(image_b, dtype=np.float64)
    if a.ndim != 2 or a.shape != b.shape or min(a.shape) < 1:
        raise InputError(f"SSIM needs two images of one shape, but got {a.shape} and {b.shape}.")
    mean_a, mean_b = _window(a), _window(b)
    var_a, var_b = _window(a * a) - mean_a**2, _window(b * b) - mean_b**2
    covariance = _window(a * b) - mean_a * mean_b
    c1, c2 = SSIM_K1**2, SSIM_K2**2
    numerator = (2 * mean_a * mean_b + c1) * (2 * covariance + c2)
    return float(np.mean(numerator / ((mean_a**2 + mean_b**2 + c1) * (var_a + var_b + c2))))


def peak_signal_to_noise(image_a: np.ndarray, image_b: np.ndarray) -> float:
    """PSNR [dB] of two images [H, W] of data range 1: -10 log₁₀ of the mean squared error; inf if equal."""
    error = float(np.mean(np.square(np.asarray(image_a, dtype=np.float64) - image_b)))
    return float(-10.0 * np.log10(error)) if error > 0 else float("inf")


def json_number(value: float | None) -> float | str | None:
    """A number as JSON can hold it: non-finite ones become text that float() reads ('inf', 'nan')."""
    if value is None:
        return None
    return float(value) if np.isfinite(value) else str(float(value))


def _window(image: np.ndarray) -> np.ndarray:
    """Gaussian-weighted local mean at the windows that lie wholly inside the image."""
    for axis, length in enumerate(image.shape):
        size = min(SSIM_WINDOW, length)
        at = np.arange(size) - 0.5 * (size - 1)
        weights = np.exp(-0.5 * (at / SSIM_SIGMA) ** 2)
        image = sliding_window_view(image, size, axis) @ (weights / weights.sum())
    return image
