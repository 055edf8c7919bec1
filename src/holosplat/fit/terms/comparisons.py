"""How predicted frames, and volumes, are compared or judged: small functions of tensors."""

from __future__ import annotations

import math
from functools import lru_cache

import torch
from torch import Tensor

from ...metrics.images import shortest_side
from ..fidelity import reference as plain


def l1(predicted: Tensor, measured: Tensor) -> Tensor:
    """Mean absolute difference of each view: [V, H, W] → [V]."""
    return (predicted - measured).abs().mean(dim=(1, 2))


def huber(predicted: Tensor, measured: Tensor, width: Tensor) -> Tensor:
    """Mean of Huber's function of the difference in each view: [V, H, W] → [V], width [V, H, W] > 0.

    `|z| - w/2`, and `z²/2w` where `|z| < w` (Huber 1964, eq. 1.3, over w): the absolute difference, squared where
    it may be noise.
    """
    size = (predicted - measured).abs()
    short = torch.minimum(size, width)
    return (short * (size - 0.5 * short) / width).mean(dim=(1, 2))


def rounded(residual: Tensor, rounding: float) -> Tensor:
    """Mean of `√(r² + c²) - c` in each view, c the `rounding`: [V, H, W] → [V]; L1 that is smooth at zero."""
    return ((residual.square() + rounding**2).sqrt() - rounding).mean(dim=(1, 2))


def l2_amplitude(predicted: Tensor, measured: Tensor) -> Tensor:
    """Mean squared difference of amplitudes √I of each view: [V, H, W] relative intensities → [V].

    The variance-stabilised (Poisson) data term; see Godard et al. (2012), eq. 9.
    """
    difference = predicted.clamp_min(1e-12).sqrt() - measured.clamp_min(0).sqrt()
    return difference.square().mean(dim=(1, 2))


def one_minus_ssim(predicted: Tensor, measured: Tensor) -> Tensor:
    """1 - SSIM of each view, [V, H, W] of data range 1 → [V] (Wang et al. 2004, eq. 13; 11 × 11, σ = 1.5)."""
    return plain.one_minus_ssim(predicted, measured, plain.statistics(measured, 0.0, 1.0))


def tv_image(image: Tensor) -> Tensor:
    """Anisotropic total variation of each view, mean over pixels: [V, H, W] → [V]."""
    return image.diff(dim=1).abs().mean(dim=(1, 2)) + image.diff(dim=2).abs().mean(dim=(1, 2))


def one_minus_frcm(predicted: Tensor, measured: Tensor) -> Tensor:
    """1 - FRCM of each view, [V, H, W] → [V]; FRCM = Σ r·FRC(r)/Σ r over rings 1 … Nyquist."""
    ring, count = _rings(predicted.shape[1], predicted.shape[2], predicted.device)
    spectra = [torch.fft.fft2(f - f.mean(dim=(1, 2), keepdim=True)).flatten(1) for f in (predicted, measured)]

    def ring_sum(values: Tensor) -> Tensor:
        return values.new_zeros(len(values), count + 1).index_add(1, ring, values)[:, 1:]

    cross = ring_sum((spectra[0] * spectra[1].conj()).real)
    power = ring_sum(spectra[0].abs().square()) * ring_sum(spectra[1].abs().square())
    weight = torch.arange(1, count + 1, dtype=predicted.dtype, device=predicted.device)
    return 1 - (cross / power.clamp_min(1e-20).sqrt() * weight).sum(1) / weight.sum()


def anisotropy(log_scales: Tensor, limit: float) -> Tensor:
    """Mean excess of log(longest/shortest axis) over log(limit): [N, 3] → scalar (Xie et al. 2024, eq. 9)."""
    if len(log_scales) == 0:
        return log_scales.sum()
    spread = log_scales.amax(dim=1) - log_scales.amin(dim=1)
    return (spread - math.log(limit)).clamp_min(0).mean()


def overfull(density: Tensor) -> Tensor:
    """Mean square of what exceeds an occupancy of one, [1, Z, Y, X] → scalar."""
    return (density.sum(dim=0) - 1).clamp_min(0).square().mean()


def two_levels(density: Tensor) -> Tensor:
    """Mean of `u (1 - u)` over occupancies u between nothing and one, [1, Z, Y, X] → scalar.

    Total variation prefers bodies that are too faint; this gives their level back, for matter is there or it is not.
    """
    return (density * (1 - density)).clamp_min(0).sum(dim=0).mean()


@lru_cache(maxsize=8)
def _rings(h: int, w: int, device: torch.device) -> tuple[Tensor, int]:
    """Ring index of each Fourier sample (0: the mean and beyond Nyquist), and the number of rings."""
    shortest = int(shortest_side((h, w), (1.0, 1.0)))  # a ring is one frequency step of it wide
    fy, fx = (torch.fft.fftfreq(n, dtype=torch.float64) * shortest for n in (h, w))
    ring = torch.floor(torch.sqrt(fy[:, None] ** 2 + fx[None] ** 2) + (0.5 + 1e-9)).long().flatten()
    count = shortest // 2
    return torch.where(ring <= count, ring, 0).to(device), count
