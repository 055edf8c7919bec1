"""Splat and voxeliser on the CPU: the C++ kernels in `native/`, in float32.

Bitwise the same for every number of threads (torch's: `torch.set_num_threads`) and in every run.
"""

from __future__ import annotations

from ctypes import c_void_p

import torch
from torch import Tensor

from ... import native
from .gradients import Arrays, Poses, drawn


def splat(cloud: Arrays, poses: Poses, shape: tuple[int, ...], cutoff: float, variance: float) -> Tensor:
    """Line integrals [V, C, H, W]; arguments and units as the package's `splat`, already checked."""
    options = native.Options(cutoff, variance, torch.get_num_threads())

    def draw(cloud: Arrays, poses: Poses) -> tuple[Tensor, Arrays]:
        views = _views(poses, shape)
        image = torch.empty(views.count, cloud[3].shape[1], *shape)
        native.call("holosplat_splat", _cloud(cloud), views, options, _at(image))
        return image, ()

    def gather(cloud: Arrays, poses: Poses, kept: Arrays, gradient: Tensor, of_poses: bool) -> tuple[Arrays, Poses]:
        out = [torch.empty_like(a) for a in cloud]
        moved = [None if a is None or not of_poses else torch.empty_like(a) for a in poses]
        outputs = (_gradients(out), native.ViewGradients(*_pointers(moved)) if of_poses else None)
        views = _views(poses, shape)
        native.call("holosplat_splat_backward", _cloud(cloud), views, options, _at(gradient), *outputs)
        return out, moved

    return drawn(cloud, [None if a is None else a.contiguous() for a in poses], draw, gather)


def voxelise(cloud: Arrays, shape: tuple[int, ...], cutoff: float, variance: float) -> Tensor:
    """Samples [C, Z, Y, X]; arguments and units as the package's `voxelise`, already checked."""
    options, grid = native.Options(cutoff, variance, torch.get_num_threads()), native.Grid(*shape)

    def draw(cloud: Arrays, poses: Poses) -> tuple[Tensor, Arrays]:
        volume = torch.empty(cloud[3].shape[1], *shape)
        native.call("holosplat_voxelise", _cloud(cloud), grid, options, _at(volume))
        return volume, ()

    def gather(cloud: Arrays, poses: Poses, kept: Arrays, gradient: Tensor, of_poses: bool) -> tuple[Arrays, Poses]:
        out = [torch.empty_like(a) for a in cloud]
        native.call("holosplat_voxelise_backward", _cloud(cloud), grid, options, _at(gradient), _gradients(out))
        return out, poses

    return drawn(cloud, (None, None, None), draw, gather)


def _at(array: Tensor) -> c_void_p:
    return c_void_p(array.data_ptr())


def _cloud(arrays: Arrays) -> native.Cloud:
    return native.Cloud(*arrays[3].shape, *_pointers(arrays))


def _gradients(arrays: Arrays) -> native.Gradients:
    return native.Gradients(*_pointers(arrays))


def _views(poses: Poses, shape: tuple[int, ...]) -> native.Views:
    assert poses[0] is not None
    return native.Views(len(poses[0]), *shape, *_pointers(poses))


def _pointers(arrays: Poses) -> list[int | None]:
    return [None if array is None else array.data_ptr() for array in arrays]
