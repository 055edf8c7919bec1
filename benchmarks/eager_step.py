"""The opponent of `step.py`: the same step as a competent user would write it in eager torch.

Splatting in patches (`plain_torch.py`), optics by autograd on a raster padded to twice the frame,
SSIM by separable `conv2d`, and `torch.optim.Adam`.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from plain_torch import splat
from torch import Tensor
from torch.nn.functional import conv2d, pad, softplus

import holosplat as hs
from holosplat.optics.propagation import fresnel_transfer, gaussian_transfer
from holosplat.units import wavenumber

CUTOFF = 4.0
"""Standard deviations, as the project's own splat has it."""


class EagerStep:
    """Parameters, optimiser, and what the optics need, for the frames [V, H, W] of a scan."""

    def __init__(self, scan: hs.Scan, cloud: hs.representations.GaussianCloud, rates: tuple[float, ...]) -> None:
        exposures, (h, w) = scan.exposures, scan.views.shape
        pitch = scan.views.pixel_size
        self.cloud = cloud.replaced(p.detach().clone().requires_grad_() for p in cloud.parameters().values())
        groups = [{"params": [p], "lr": rate} for p, rate in zip(self.cloud.parameters().values(), rates)]
        self.optimiser = torch.optim.Adam(groups, eps=1e-12)
        self.rotations = torch.from_numpy(scan.views.rotations).float()
        self.shape, self.margin = (h, w), (h // 2, w // 2)
        padded, energy = (2 * h, 2 * w), exposures.one_energy("the eager step")
        self.transfer = fresnel_transfer(padded, pitch, exposures.distance, energy, torch.complex64)
        self.blur = gaussian_transfer(padded, exposures.psf_sigma_px, torch.float32)
        self.phase = wavenumber(energy) * cloud.matter.delta * cloud.unit_length
        self.loss_of_amplitude = wavenumber(energy) * cloud.matter.beta * cloud.unit_length
        low, high = float(scan.frames.min()), float(scan.frames.max())
        self.low, self.span = low, high - low
        self.measured = (torch.from_numpy(scan.frames) - low) / self.span

    def frames(self) -> Tensor:
        """Predicted frames [V, H, W]."""
        centres, log_scales, quaternions, raw = self.cloud.parameters().values()
        lines = splat(centres, log_scales.exp(), quaternions, softplus(raw), self.rotations, self.shape, CUTOFF)
        my, mx = self.margin
        lines = pad(lines, (mx, mx, my, my))
        wave = torch.exp(torch.complex(-self.loss_of_amplitude * lines[:, 1], -self.phase * lines[:, 0]))
        wave = torch.fft.ifft2(torch.fft.fft2(wave) * self.transfer)
        intensity = torch.fft.irfft2(torch.fft.rfft2(wave.abs() ** 2) * self.blur, s=wave.shape[1:])
        (h, w) = self.shape
        return intensity[:, my : my + h, mx : mx + w]

    def step(self) -> float:
        """One step: forward, backward, Adam; returns the loss 0.8 L1 + 0.2 (1 - SSIM)."""
        self.optimiser.zero_grad()
        predicted = (self.frames() - self.low) / self.span
        difference = (predicted - self.measured).abs().mean()
        loss = 0.8 * difference + 0.2 * (1 - ssim(predicted, self.measured))
        loss.backward()
        self.optimiser.step()
        return float(loss.detach())


def ssim(a: Tensor, b: Tensor) -> Tensor:
    """Mean SSIM of images [V, H, W] of data range 1 (Wang et al. 2004), 11 × 11 Gaussian window, σ = 1.5."""
    offsets = np.arange(11) - 5
    window = torch.tensor([math.exp(-0.5 * (k / 1.5) ** 2) for k in offsets])
    window = (window / window.sum()).reshape(1, 1, 1, 11)

    def mean(image: Tensor) -> Tensor:
        return conv2d(conv2d(image[:, None], window), window.mT)[:, 0]

    mean_a, mean_b = mean(a), mean(b)
    var_a, var_b = mean(a * a) - mean_a**2, mean(b * b) - mean_b**2
    covariance = mean(a * b) - mean_a * mean_b
    top = (2 * mean_a * mean_b + 0.01**2) * (2 * covariance + 0.03**2)
    return (top / ((mean_a**2 + mean_b**2 + 0.01**2) * (var_a + var_b + 0.03**2))).mean()
