"""From the wave's intensity to a frame: pixel integration, point-spread function, photon noise."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from ..checks import positive


def bin_pixels(image: Tensor, factor: int) -> Tensor:
    """[V, H·factor, W·factor] → [V, H, W]: the mean over each pixel's `factor × factor` samples."""
    return image if factor == 1 else avg_pool2d(image[None], factor)[0]


def gaussian_transfer(shape: tuple[int, int], sigma_px: np.ndarray, dtype: torch.dtype) -> Tensor:
    """Fourier transform of Gaussian point-spread functions, [V, H, W//2 + 1] (for `rfft2`); see `gaussian_factors`."""
    sigma = torch.from_numpy(np.asarray(sigma_px, dtype=np.float64))
    rows, columns = gaussian_factors(shape, sigma, torch.float64)
    return (rows[:, :, None] * columns[:, None, : shape[1] // 2 + 1]).to(dtype)


def gaussian_factors(shape: tuple[int, int], sigma_px: Tensor, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """The factors `exp(-2π²σ²fy²)` [V, H] and `exp(-2π²σ²fx²)` [V, W] of Gaussian point-spread functions' transforms.

    sigma_px: [V] standard deviations in samples of the raster `shape`, float64, whose gradient the factors pass on.
    They depend on σ², so the gradient is zero at σ = 0 exactly.
    """
    exponent, on = -2 * math.pi**2 * sigma_px.reshape(-1, 1) ** 2, sigma_px.device
    frequencies = (torch.fft.fftfreq(n, dtype=torch.float64, device=on) for n in shape)
    rows, columns = (torch.exp(exponent * f**2).to(dtype) for f in frequencies)
    return rows, columns


def blur(image: Tensor, transfer: Tensor) -> Tensor:
    """`image` [V, H, W] blurred (periodically) by the point-spread functions whose `rfft2` is `transfer`."""
    return torch.fft.irfft2(torch.fft.rfft2(image) * transfer, s=image.shape[-2:])


def poisson(intensity: np.ndarray, photons_per_pixel: float, seed: int | np.random.Generator) -> np.ndarray:
    """Relative intensity [..., H, W] with photon noise: Poisson counts of mean `I · photons_per_pixel`, divided by it.

    seed: a seed, or a generator to draw on: frames one by one then get the same noise as all at once.
    """
    photons = positive("photons_per_pixel", photons_per_pixel)
    counts = np.random.default_rng(seed).poisson(np.clip(intensity, 0, None) * photons)
    return (counts / photons).astype(np.float32)
