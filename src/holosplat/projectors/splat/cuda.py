"""Splat and voxeliser on the GPU: autograd functions over the Triton kernels beside this file, in float32.

Nothing here waits for the device, and launches depend on shapes alone, so that all of it can be captured in a CUDA
graph once the kernels are compiled (by a first call outside the capture) and the views are on the device. Images are
sums in any order and differ in their last bits from run to run; gradients, for an equal image gradient, do not.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ...launch import launching
from . import triton_splat, triton_voxels


def splat(
    centres: Tensor,
    scales: Tensor,
    quaternions: Tensor,
    amplitudes: Tensor,
    rotations: Tensor,
    shifts: Tensor,
    curvatures: Tensor | None,
    shape: tuple[int, ...],
    cutoff: float,
    pixel_variance: float,
) -> Tensor:
    """Line integrals [V, C, H, W]; arguments and units as the package's `splat`, already checked.

    rotations, shifts and curvatures in float64 on the device are used where they lie; from elsewhere they are copied.
    """
    poses = tuple(
        None if a is None else a.to(centres.device, torch.float64).contiguous() for a in (rotations, shifts, curvatures)
    )
    options = (cutoff, pixel_variance)
    return _Splat.apply(centres, scales, quaternions, amplitudes, *poses, shape, options)  # type: ignore[no-any-return]


def voxelise(
    centres: Tensor,
    scales: Tensor,
    quaternions: Tensor,
    amplitudes: Tensor,
    shape: tuple[int, ...],
    cutoff: float,
    voxel_variance: float,
) -> Tensor:
    """Samples [C, Z, Y, X]; arguments and units as the package's `voxelise`, already checked."""
    options = (cutoff, voxel_variance)
    return _Voxelise.apply(centres, scales, quaternions, amplitudes, shape, options)  # type: ignore[no-any-return]


class _Splat(torch.autograd.Function):
    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any,
        centres: Tensor,
        scales: Tensor,
        quaternions: Tensor,
        amplitudes: Tensor,
        rotations: Tensor,
        shifts: Tensor,
        curvatures: Tensor | None,
        shape: tuple[int, ...],
        options: tuple[float, float],
    ) -> Tensor:
        cloud = tuple(a.contiguous() for a in (centres, scales, quaternions, amplitudes))
        poses = (rotations, shifts, curvatures)
        with launching(centres):
            image, records = triton_splat.draw(cloud, poses, shape, *options)
        ctx.save_for_backward(*cloud, *poses, *records)
        ctx.variance = options[1]
        return image

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        saved, of_poses = ctx.saved_tensors, any(ctx.needs_input_grad[4:7])
        inputs = (saved[:4], saved[4:7], saved[7:], gradient.contiguous())
        with launching(gradient):
            out, moved = triton_splat.gather(*inputs, ctx.variance, of_poses)
        return *out, *moved, None, None


class _Voxelise(torch.autograd.Function):
    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any,
        centres: Tensor,
        scales: Tensor,
        quaternions: Tensor,
        amplitudes: Tensor,
        shape: tuple[int, ...],
        options: tuple[float, float],
    ) -> Tensor:
        cloud = tuple(a.contiguous() for a in (centres, scales, quaternions, amplitudes))
        with launching(centres):
            volume, records = triton_voxels.draw(cloud, shape, *options)
        ctx.save_for_backward(*cloud, *records)
        ctx.variance = options[1]
        return volume

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        saved = ctx.saved_tensors
        with launching(gradient):
            out = triton_voxels.gather(saved[:4], saved[4:], gradient.contiguous(), ctx.variance)
        return *out, None, None
