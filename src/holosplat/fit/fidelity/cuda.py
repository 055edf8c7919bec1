"""L1 and SSIM of frames on the GPU, with the gradient: an autograd function over Triton kernels, in float32.

Like the CPU's, this computes 1 - SSIM from moments of the difference d = a - b, in which nothing cancels where the
frames agree. With m = E d and s = E d² - m² under the window, 1 - SSIM = p + q - p q, where p = m² / (μa² + μb² + c1)
and q = s / (σa² + σb² + c2): the two factors of Wang et al. (2004), eq. 13, are 1 - p and 1 - q.
Sums run in a fixed order: results are bitwise the same in every run. Nothing waits for the device.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ...launch import launching
from . import triton_fidelity

WINDOW, SIGMA = 11, 1.5


def statistics(frames: Tensor, low: float, span: float) -> Tensor:
    """Local mean and variance [V, 2, h, w] of frames [V, H, W], mapped such that `low` becomes 0 and `low + span` 1.

    Under the Gaussian window of SSIM, wholly inside: h = H - 10, w = W - 10; shorter sides have one window.
    """
    b = (frames.double() - low) / span - 0.5  # float64: this is done once, and E b² - (E b)² cancels
    mean, square = _local_mean(b), _local_mean(b * b)
    return torch.stack([mean + 0.5, (square - mean * mean).clamp_min(0)], dim=1).float()


def l1_and_ssim(
    predicted: Tensor, frames: Tensor, statistics: Tensor, low: float, span: float
) -> tuple[Tensor, Tensor]:
    """Mean absolute difference [V] and 1 - SSIM [V] of predicted and measured frames [V, H, W], in the same mapping.

    `statistics` are those of `frames`; gradients are of `predicted` alone.
    """
    return _Fidelity.apply(predicted, frames, statistics, low, span)  # type: ignore[no-any-return]


def window(length: int) -> tuple[float, ...]:
    """The Gaussian window along a side of `length` pixels: 11 weights that sum to one, or `length` if that is less."""
    width = min(WINDOW, length)
    weights = [math.exp(-0.5 * ((k - (width - 1) / 2) / SIGMA) ** 2) for k in range(width)]
    return tuple(weight / sum(weights) for weight in weights)


def _local_mean(image: Tensor) -> Tensor:
    for dimension in (1, 2):
        weights = window(image.shape[dimension])
        length = image.shape[dimension] - len(weights) + 1
        terms = (weight * image.narrow(dimension, k, length) for k, weight in enumerate(weights))
        image = sum(terms, start=torch.zeros((), dtype=image.dtype, device=image.device))
    return image


class _Fidelity(torch.autograd.Function):
    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any, predicted: Tensor, frames: Tensor, statistics: Tensor, low: float, span: float
    ) -> tuple[Tensor, Tensor]:
        arrays = tuple(a.contiguous() for a in (predicted, frames, statistics))
        windows = (window(frames.shape[1]), window(frames.shape[2]))
        with launching(predicted):
            values, slopes = triton_fidelity.compare(arrays, windows, low, span, ctx.needs_input_grad[0])
        ctx.save_for_backward(*arrays[:2], slopes)
        ctx.windows, ctx.mapping = windows, (low, span)
        return values[0], values[1]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, l1: Tensor, ssim: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        upstream = torch.stack([l1, ssim])
        with launching(upstream):
            out = triton_fidelity.differentiate(ctx.saved_tensors, upstream, ctx.windows, *ctx.mapping)
        return out, None, None, None, None
