"""L1 and SSIM of frames in plain torch: the specification, in any float type, on any device."""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor

WINDOW, SIGMA = 11, 1.5
C1, C2 = 0.01**2, 0.03**2
"""Stabilisers of the ratios of means and of variances, for a data range of 1."""


def statistics(frames: Tensor, low: float, span: float) -> Tensor:
    """Local mean and variance [V, 2, h, w] of frames [V, H, W]; as the package's `statistics`."""
    b = (frames - low) / span
    mean = local_mean(b)
    return torch.stack([mean, (local_mean(b * b) - mean**2).clamp_min(0)], dim=1)


def l1_and_ssim(
    predicted: Tensor, frames: Tensor, statistics: Tensor, low: float, span: float
) -> tuple[Tensor, Tensor]:
    """Mean absolute difference [V] and 1 - SSIM [V]; as the package's `l1_and_ssim`."""
    a, b = (predicted - low) / span, (frames - low) / span
    return (a - b).abs().mean(dim=(1, 2)), one_minus_ssim(a, b, statistics)


def one_minus_ssim(a: Tensor, b: Tensor, statistics: Tensor) -> Tensor:
    """1 - SSIM [V] of images [V, H, W] of data range 1, given those of `b` (Wang et al. 2004, eq. 13)."""
    mean_a, mean_b, variance_b = local_mean(a), statistics[:, 0], statistics[:, 1]
    variance_a = local_mean(a * a) - mean_a**2
    covariance = local_mean(a * b) - mean_a * mean_b
    means = (2 * mean_a * mean_b + C1) / (mean_a**2 + mean_b**2 + C1)
    variances = (2 * covariance + C2) / (variance_a + variance_b + C2)
    return 1 - (means * variances).mean(dim=(1, 2))


def local_mean(image: Tensor) -> Tensor:
    """The mean of [V, H, W] under the window, [V, h, w]: 11 × 11 pixels, Gaussian of σ = 1.5, wholly inside."""
    rows, columns = (_window_matrix(n, image.dtype, image.device) for n in image.shape[1:])
    return rows @ image @ columns.T


@lru_cache(maxsize=8)
def _window_matrix(n: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """[n - 10, n]: the window as a banded matrix (of one row, if a side is shorter than it)."""
    width = min(WINDOW, n)
    weights = torch.exp(-0.5 * ((torch.arange(width, dtype=torch.float64) - (width - 1) / 2) / SIGMA) ** 2)
    matrix = torch.zeros(n - width + 1, n, dtype=torch.float64)
    for i in range(len(matrix)):
        matrix[i, i : i + width] = weights / weights.sum()
    return matrix.to(device, dtype)
