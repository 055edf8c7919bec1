"""Total variation on the CPU: value and gradient of one channel in one pass of the compiled kernel, float32."""

from __future__ import annotations

import math
from ctypes import c_void_p
from typing import Any

import torch
from torch import Tensor

from ... import native


def total_variation(density: Tensor, smoothing: float) -> Tensor:
    """[C, Z, Y, X] → scalar; as the package's `total_variation`."""
    return torch.stack([_TotalVariation.apply(channel, smoothing) for channel in density]).mean()


class _TotalVariation(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, density: Tensor, smoothing: float) -> Tensor:  # type: ignore[override]
        volume = density.detach().contiguous()
        gradient, value = torch.empty_like(volume), torch.zeros(1, dtype=torch.float64)
        source, slope, total = (c_void_p(array.data_ptr()) for array in (volume, gradient, value))
        threads = torch.get_num_threads()
        native.call("holosplat_tv_smooth", native.Grid(*volume.shape), source, smoothing, slope, total, threads)
        voxels = math.prod(n - 1 for n in volume.shape)
        ctx.save_for_backward(gradient)
        ctx.voxels = voxels
        return (value[0] / voxels).to(density.dtype)

    @staticmethod
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor, None]:  # type: ignore[override]
        (gradient,) = ctx.saved_tensors
        return gradient * (upstream / ctx.voxels), None
