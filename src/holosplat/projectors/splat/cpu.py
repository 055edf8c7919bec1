"""Splat and voxeliser on the CPU: autograd functions over the C++ kernels in `native/`, in float32.

Bitwise the same for every number of threads (torch's: `torch.set_num_threads`) and in every run.
"""

from __future__ import annotations

from collections.abc import Sequence
from ctypes import c_void_p
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ... import native


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
    """Line integrals [V, C, H, W]; arguments and units as the package's `splat`, already checked."""
    options = native.Options(cutoff, pixel_variance, torch.get_num_threads())
    poses = (rotations.contiguous(), shifts.contiguous(), None if curvatures is None else curvatures.contiguous())
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
    options = native.Options(cutoff, voxel_variance, torch.get_num_threads())
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
        options: native.Options,
    ) -> Tensor:
        arrays = [a.contiguous() for a in (centres, scales, quaternions, amplitudes)]
        poses = (rotations, shifts, curvatures)
        ctx.save_for_backward(*arrays, *poses)
        ctx.shape, ctx.options = shape, options
        image = torch.empty(len(rotations), amplitudes.shape[1], *shape)
        native.call("holosplat_splat", _cloud(arrays), _views(poses, shape), options, _at(image))
        return image

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        arrays, poses = ctx.saved_tensors[:4], ctx.saved_tensors[4:]
        out = [torch.empty_like(a) for a in arrays]
        wanted = any(ctx.needs_input_grad[4:7])
        moved = [None if a is None or not wanted else torch.empty_like(a) for a in poses]
        outputs = (_gradients(out), native.ViewGradients(*_pointers(moved)) if wanted else None)
        views, gradient = _views(poses, ctx.shape), gradient.contiguous()
        native.call("holosplat_splat_backward", _cloud(arrays), views, ctx.options, _at(gradient), *outputs)
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
        options: native.Options,
    ) -> Tensor:
        arrays = [a.contiguous() for a in (centres, scales, quaternions, amplitudes)]
        ctx.save_for_backward(*arrays)
        ctx.shape, ctx.options = shape, options
        volume = torch.empty(amplitudes.shape[1], *shape)
        native.call("holosplat_voxelise", _cloud(arrays), native.Grid(*shape), options, _at(volume))
        return volume

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        arrays = ctx.saved_tensors
        out = [torch.empty_like(a) for a in arrays]
        grid, gradient = native.Grid(*ctx.shape), gradient.contiguous()
        native.call("holosplat_voxelise_backward", _cloud(arrays), grid, ctx.options, _at(gradient), _gradients(out))
        return *out, None, None


def _at(array: Tensor) -> c_void_p:
    return c_void_p(array.data_ptr())


def _cloud(arrays: list[Tensor] | tuple[Tensor, ...]) -> native.Cloud:
    return native.Cloud(*arrays[3].shape, *(a.data_ptr() for a in arrays))


def _gradients(arrays: list[Tensor]) -> native.Gradients:
    return native.Gradients(*(a.data_ptr() for a in arrays))


def _views(poses: Sequence[Tensor | None], shape: tuple[int, ...]) -> native.Views:
    assert poses[0] is not None
    return native.Views(len(poses[0]), *shape, *_pointers(poses))


def _pointers(arrays: Sequence[Tensor | None]) -> list[int | None]:
    return [None if array is None else array.data_ptr() for array in arrays]
