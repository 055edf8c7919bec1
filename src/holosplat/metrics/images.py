"""Scores of predicted against measured images: SSIM, PSNR, L1, and the mean Fourier ring correlation.

Intensities are first mapped affinely so that the minimum and maximum over all *training* frames become 0 and
1; nothing is clipped. SSIM, PSNR and L1 are then taken with a data range of 1. FRC does not depend on the
map.

Fourier ring and shell correlation, their thresholds, and the resolution they give:

`FRC(r) = Re Σ F₁F₂* / sqrt(Σ|F₁|² Σ|F₂|²)` over ring `r` (Saxton & Baumeister 1982; Harauz &
van Heel 1986), of mean-subtracted arrays, without apodisation.

Both thresholds apply to two independent halves of one data set. Against a noise-free truth the same reconstruction
correlates as the square root of 2 FSC / (1 + FSC), so they are lenient there: 0.143 between halves corresponds to 0.5
against the truth (Rosenthal & Henderson 2003).

Rings. One frequency step is the step of the shortest side, `1 / min(n d)` for `n` samples of spacing `d`: the coarsest
step, so that every ring has samples along each axis. (With the finer step of a long side, rings that hold samples of
the short axis alternate with rings that do not, and the curve oscillates. Sides of fewer than four samples, such as
those of a fan of a few slices, have no rings of their own and do not count.) A sample of frequency `|f|` belongs to
ring `floor(|f| / step + ½)`; rings run from 1 to the Nyquist frequency of the coarsest spacing. A square image of N
pixels has the textbook rings 1 … ⌊N/2⌋ about the integer radii.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from ..checks import InputError, finite, positive, require, shaped
from ..frames import rfft_weights

FIXED_THRESHOLD = 0.143
"""The fixed threshold 1/7 between two half data sets (Rosenthal & Henderson 2003, J. Mol. Biol. 333, 721)."""

FEWEST_SAMPLES = 4
"""Samples of a side from which on its frequencies make rings."""


def fourier_ring_correlation(image_a: np.ndarray, image_b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fourier ring correlation of two images [H, W] of any (equal) unit, also rectangular or odd.

    Returns `(frequency, frc)`, both [R] float64: frequencies of rings 1 … Nyquist [cycles/pixel], and the
    correlation in [-1, 1], which is 0 where either image has no power. Identical images give 1.
    Raises `InputError` for arrays that are not two finite images of one shape.
    """
    return _correlate(image_a, image_b, 2, None)


def fourier_shell_correlation(
    volume_a: np.ndarray, volume_b: np.ndarray, spacing: Sequence[float] | np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Fourier shell correlation of two volumes [Z, Y, X] of any (equal) unit, cubic or not.

    spacing: relative voxel edges `(dz, dy, dx)`, in units of the voxel that "cycles/voxel" refers to; None:
    all 1. Returns `(frequency, fsc)`, both [R] float64: frequencies of shells 1 … Nyquist [cycles/voxel], and
    the correlation in [-1, 1], which is 0 where either volume has no power. Raises `InputError` for arrays
    that are not two finite volumes of one shape.
    """
    return _correlate(volume_a, volume_b, 3, spacing)


def ring_counts(shape: tuple[int, ...], spacing: Sequence[float] | np.ndarray | None = None) -> np.ndarray:
    """Fourier samples n(r) [R] in the rings (2D) or shells (3D) 1 … Nyquist of an array of `shape`.

    Both halves of the Hermitian-symmetric transform count, as in van Heel & Schatz 2005.
    """
    ring, weight, count = _rings(shape, spacing)
    return np.bincount(ring.ravel(), weight.ravel(), minlength=count + 1)[1 : count + 1]


def half_bit_threshold(counts: np.ndarray) -> np.ndarray:
    """½-bit threshold [R] for `counts` [R] Fourier samples per ring (van Heel & Schatz 2005).

    T = (0.2071 + 1.9102/√n) / (1.2071 + 0.9102/√n): the correlation at which two half data sets together
    carry half a bit of information per Fourier sample; it tends to 0.1716 for n → ∞ and is 1 at n = 1.
    """
    snr = (math.sqrt(2.0) - 1.0) / 2.0  # log2(1 + 2 SNR) = ½ for the sum of both halves: SNR = 0.2071 of each
    root = 1.0 / np.sqrt(np.maximum(np.asarray(counts, dtype=np.float64), 1.0))
    cross = 2.0 * math.sqrt(snr) * root
    return (snr + cross + root) / (snr + 1.0 + cross)


def resolution(frequency: np.ndarray, curve: np.ndarray, threshold: float | np.ndarray, pitch: float) -> float | None:
    """Full-period resolution [m] `pitch / f` where `curve` first falls below `threshold`.

    frequency: [R] [cycles/pixel]; curve: [R]; threshold: one number or [R]; pitch: [m] per pixel. The
    crossing is interpolated linearly between rings. `inf`: below from the first ring on (nothing is
    resolved). None: never below, so the sampling is the limit, two pixels. Raises `InputError` for curves of
    different lengths.
    """
    frequency, curve = np.asarray(frequency, dtype=np.float64), np.asarray(curve, dtype=np.float64)
    require(
        frequency.ndim == 1 and frequency.shape == curve.shape and len(curve) > 0,
        f"a correlation curve must match its frequencies, but got {curve.shape} and {frequency.shape}.",
    )
    above = curve - np.broadcast_to(np.asarray(threshold, dtype=np.float64), curve.shape)
    below = np.flatnonzero(above < 0)
    if not below.size:
        return None
    last = int(below[0])
    if last == 0:
        return math.inf
    part = above[last - 1] / (above[last - 1] - above[last])
    crossing = frequency[last - 1] + part * (frequency[last] - frequency[last - 1])
    return positive("pitch", pitch, "metres") / float(crossing)


def ring_weighted_mean(curve: np.ndarray) -> np.ndarray:
    """FRCM = Σ r·FRC(r) / Σ r over rings 1 … R: of `curve` [..., R], a number per leading index."""
    curve = np.asarray(curve, dtype=np.float64)
    radius = np.arange(1, curve.shape[-1] + 1, dtype=np.float64)
    return curve @ radius / radius.sum()


def _correlate(
    first: np.ndarray, second: np.ndarray, ndim: int, spacing: Sequence[float] | np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    a, b = (np.asarray(array, dtype=np.float64) for array in (first, second))
    kind = "two images" if ndim == 2 else "two volumes"
    if a.ndim != ndim or a.shape != b.shape:
        raise InputError(f"a Fourier correlation needs {kind} of one shape, but got {a.shape} and {b.shape}.")
    finite("first array of the Fourier correlation", a)
    finite("second array of the Fourier correlation", b)
    ring, weight, count = _rings(a.shape, spacing)
    index = ring.ravel()
    spectrum_a, spectrum_b = (np.fft.rfftn(array - array.mean()).ravel() for array in (a, b))

    def over_rings(values: np.ndarray) -> np.ndarray:
        return np.bincount(index, weight.ravel() * values, minlength=count + 1)[1 : count + 1]

    shared = over_rings((spectrum_a * spectrum_b.conj()).real)
    power_a, power_b = (over_rings(np.abs(s) ** 2) for s in (spectrum_a, spectrum_b))
    norm = np.sqrt(power_a) * np.sqrt(power_b)
    curve = np.divide(shared, norm, out=np.zeros_like(shared), where=norm > 0)
    return np.arange(1, count + 1) / shortest_side(a.shape, np.ones(ndim) if spacing is None else spacing), curve


def shortest_side(shape: Sequence[int], spacing: Sequence[float] | np.ndarray) -> float:
    """The length of the shortest side that has `FEWEST_SAMPLES`, or of the longest where none has."""
    sides = np.asarray(shape) * np.asarray(spacing)
    sampled = sides[np.asarray(shape) >= FEWEST_SAMPLES]
    return float(sampled.min() if len(sampled) else sides.max())


def _rings(shape: tuple[int, ...], spacing: Sequence[float] | np.ndarray | None) -> tuple[np.ndarray, np.ndarray, int]:
    """Ring index and Hermitian weight of each sample of a real transform, and the number of the last ring."""
    steps = np.ones(len(shape)) if spacing is None else np.asarray(spacing, dtype=np.float64)
    if len(steps) != len(shape) or not np.all(steps > 0):
        raise InputError(f"spacing must be {len(shape)} positive numbers, one an axis, but it is {spacing}.")
    shortest = shortest_side(shape, steps)
    last = math.floor(shortest * 0.5 / float(steps.max()) + 1e-9)
    require(
        last >= 1,
        f"a Fourier correlation needs at least two samples along an axis, but the shape is {shape}.",
    )
    axes = [np.abs(np.fft.fftfreq(n, d)) for n, d in zip(shape[:-1], steps[:-1])]
    axes.append(np.fft.rfftfreq(shape[-1], steps[-1]))
    squared = sum(np.square(f * shortest) for f in np.meshgrid(*axes, indexing="ij", sparse=True))
    ring = np.floor(np.sqrt(squared) + (0.5 + 1e-9)).astype(np.intp)
    return ring, np.broadcast_to(rfft_weights(shape[-1]), ring.shape), last


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
