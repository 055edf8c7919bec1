"""L1 and SSIM of frames on the CPU: an autograd function over the C++ kernels in `native/`, in float32.

Bitwise the same for every number of threads (torch's: `torch.set_num_threads`) and in every run.
"""

from __future__ import annotations

from ctypes import c_void_p
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ... import native
from . import reference


def statistics(frames: Tensor, low: float, span: float) -> Tensor:
    """Local mean and variance [V, 2, h, w] of frames [V, H, W]; as the package's `statistics`."""
    if _is_small(frames):
        return reference.statistics(frames.double(), low, span).float()
    frames = frames.contiguous()
    (v, height, width), halo = frames.shape, reference.WINDOW - 1
    out = torch.empty(v, 2, height - halo, width - halo)
    target = native.Target(v, height, width, frames.data_ptr(), None, low, span)
    native.call("holosplat_fidelity_statistics", target, _at(out), torch.get_num_threads())
    return out


def l1_and_ssim(
    predicted: Tensor, frames: Tensor, statistics: Tensor, low: float, span: float
) -> tuple[Tensor, Tensor]:
    """Mean absolute difference [V] and 1 - SSIM [V]; as the package's `l1_and_ssim`."""
    if _is_small(frames):
        predicted, frames = predicted.double(), frames.double()
        exact = reference.statistics(frames, low, span)  # rounded ones are too coarse for the plain form
        l1, ssim = reference.l1_and_ssim(predicted, frames, exact, low, span)
        return l1.float(), ssim.float()
    wants_gradient = torch.is_grad_enabled() and predicted.requires_grad
    return _Fidelity.apply(predicted, (frames, statistics), (low, span), wants_gradient)  # type: ignore[no-any-return]


class _Fidelity(torch.autograd.Function):
    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any,
        predicted: Tensor,
        measured: tuple[Tensor, Tensor],
        mapping: tuple[float, float],
        wants_gradient: bool,
    ) -> tuple[Tensor, Tensor]:
        predicted, frames, statistics = (a.contiguous() for a in (predicted, *measured))
        values = torch.empty(len(frames), 2, dtype=torch.float64)
        slopes = torch.empty_like(predicted) if wants_gradient else None
        outputs = _at(values), c_void_p(None) if slopes is None else _at(slopes)
        target = _target(frames, statistics, mapping)
        native.call("holosplat_fidelity", target, _at(predicted), *outputs, torch.get_num_threads())
        if slopes is not None:
            ctx.save_for_backward(predicted, frames, statistics, slopes)
        ctx.mapping = mapping
        l1, ssim = values.float().unbind(dim=1)
        return l1.clone(), ssim.clone()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, l1: Tensor, ssim: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        predicted, frames, statistics, slopes = ctx.saved_tensors
        upstream, out = torch.stack([l1, ssim], dim=1), torch.empty_like(predicted)
        target, arrays = _target(frames, statistics, ctx.mapping), (predicted, upstream, slopes, out)
        native.call("holosplat_fidelity_backward", target, *(_at(a) for a in arrays), torch.get_num_threads())
        return out, None, None, None


def _is_small(frames: Tensor) -> bool:
    """Whether the window shrinks: such images are tiny in one direction, and the plain form is fast enough."""
    return min(frames.shape[1:]) < reference.WINDOW


def _target(frames: Tensor, statistics: Tensor, mapping: tuple[float, float]) -> native.Target:
    return native.Target(*frames.shape, frames.data_ptr(), statistics.data_ptr(), *mapping)


def _at(array: Tensor) -> c_void_p:
    return c_void_p(array.data_ptr())
