"""Half-steps of total variation by the compiled kernels: contiguous float32 volumes [Z, Y, X], changed in place."""

from __future__ import annotations

from ctypes import c_void_p

import torch
from torch import Tensor

from ... import native


def ascend(u: Tensor, q: Tensor, step: float, radius: float) -> None:
    """q [3, Z, Y, X] ← projection of `q + step ∇u` onto balls of `radius`; forward differences."""
    native.call("holosplat_tv_ascend", _grid(u), _pointer(u), _pointer(q), step, radius, torch.get_num_threads())


def descend(
    slope: Tensor,
    tau: Tensor,
    q: Tensor,
    coupling: float,
    bounds: tuple[float, float],
    u: Tensor,
    extrapolated: Tensor,
) -> None:
    """u ← `clamp(u - tau (slope + coupling ∇ᵀq), *bounds)`, extrapolated ← `2 u_new - u_old`.

    q must be zero where a forward difference would leave the volume, as `ascend` keeps it.
    """
    arrays = [_pointer(a) for a in (slope, tau, q)]
    moved = [_pointer(a) for a in (u, extrapolated)]
    native.call("holosplat_tv_descend", _grid(u), *arrays, coupling, *bounds, *moved, torch.get_num_threads())


def _grid(volume: Tensor) -> native.Grid:
    return native.Grid(*volume.shape)


def _pointer(array: Tensor) -> c_void_p:
    assert array.dtype == torch.float32
    assert array.is_contiguous()
    return c_void_p(array.data_ptr())
