"""Half-steps of total variation on the GPU: contiguous float32 volumes [Z, Y, X], changed in place, one launch each."""

from __future__ import annotations

import torch
from torch import Tensor

from ...launch import launching
from . import triton_tv


def ascend(u: Tensor, q: Tensor, step: float, radius: float) -> None:
    """q [3, Z, Y, X] ← projection of `q + step ∇u` onto balls of `radius`; forward differences."""
    _require_plain(u, q)
    with launching(u):
        triton_tv.ascend(u, q, float(step), float(radius))


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
    _require_plain(slope, tau, q, u, extrapolated)
    with launching(u):
        triton_tv.descend(slope, tau, q, float(coupling), bounds, u, extrapolated)


def _require_plain(*arrays: Tensor) -> None:
    assert all(array.dtype == torch.float32 and array.is_contiguous() for array in arrays)
