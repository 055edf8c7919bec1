"""One damped Gauss–Newton step of the numbers of every view, beside what is expected of them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ..optics.noise import left_of
from .derivatives import Predicted


@dataclass(frozen=True)
class Normal:
    """Information of frames on K parameters of each of V views, near the present ones; frames of a view add up.

    information: [V, K, K], the Hessian of half the squared residuals over their noise
    slope: [V, K], how fast these fall along each number
    """

    information: Tensor
    slope: Tensor

    @classmethod
    def of(cls, measured: Tensor, found: Predicted, blur: float) -> Normal:
        """measured: frames [V, H, W], NaN in pixels without a value; found: at the present numbers, flux included;
        blur: standard deviation of a Gaussian [pixels] by which images are compared. The noise of a view is what it
        leaves unexplained, as it is after that blur: this many independent pixels."""
        known = ~measured.isnan()
        missing = blurred(left_of(measured, found.frames), blur).flatten(1).double()
        columns = blurred(found.derivatives * known[:, None], blur).flatten(2).double()
        independent = 1 / (4 * math.pi * blur**2)
        scale = independent / (missing.square().sum(1) / known.sum((1, 2))).clamp_min(1e-18)
        information = torch.einsum("vip,vjp->vij", columns, columns) * scale[:, None, None]
        return cls(information, torch.einsum("vip,vp->vi", columns, missing) * scale[:, None])

    def in_units(self, scales: Tensor) -> Normal:
        """The same for numbers `scales` [K] times larger."""
        return Normal(self.information / (scales[:, None] * scales), self.slope / scales)


@dataclass(frozen=True)
class Step:
    """numbers: [V, K] after the step; covariances: [V, K, K] of them, by frames and prior, for a known volume."""

    numbers: Tensor
    covariances: Tensor


def step(normal: Normal, numbers: Tensor, expected: Tensor) -> Step:
    """The likeliest numbers near the present ones (Levenberg 1944, with the prior as damping); float64.

    numbers: [V, K]; expected: [K] standard deviations of the numbers about zero, 0 for those that stay.
    """
    free = expected > 0
    information, slope = normal.information[:, free][:, :, free], normal.slope[:, free]
    prior = expected[free] ** -2
    covariances = torch.linalg.inv(information + torch.diag(prior))
    moved = torch.einsum("vij,vj->vi", covariances, slope - prior * numbers[:, free])
    after = numbers.clone()
    after[:, free] += moved
    whole = torch.zeros(*numbers.shape, numbers.shape[1], dtype=numbers.dtype)
    places = torch.nonzero(free)[:, 0]
    whole[:, places[:, None], places] = covariances
    return Step(after, whole)


def blurred(images: Tensor, sigma: float) -> Tensor:
    """Images [..., H, W] convolved with a Gaussian of `sigma` [pixels], periodically."""
    h, w = images.shape[-2:]
    squares = torch.fft.fftfreq(h)[:, None] ** 2 + torch.fft.rfftfreq(w) ** 2
    return torch.fft.irfft2(torch.fft.rfft2(images) * torch.exp(-2 * math.pi**2 * sigma**2 * squares), s=(h, w))


def unexplained(measured: Tensor, images: Tensor) -> Tensor:
    """[V, H, W] what images leave of frames, over each frame's contrast; 0 in pixels of these that are NaN."""
    return left_of(measured, images) / contrast_of(measured)


def contrast_of(measured: Tensor) -> Tensor:
    """[V, 1, 1] standard deviation of frames [V, H, W] in pixels that are not NaN."""
    away = (measured - measured.nanmean(dim=(1, 2), keepdim=True)).square().nansum(dim=(1, 2), keepdim=True)
    return (away / ((~measured.isnan()).sum(dim=(1, 2), keepdim=True) - 1)).sqrt().clamp_min(1e-12)


def rms_of(images: Tensor) -> np.ndarray:
    """[V] root mean squares of images [V, H, W]."""
    return images.double().square().mean((1, 2)).sqrt().numpy()
