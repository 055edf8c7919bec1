"""Half-steps of total variation on the GPU: contiguous float32 volumes [Z, Y, X], changed in place, one launch each.

A lane takes a voxel, as in `native/primal_dual.cpp`.
"""

# pyright: reportGeneralTypeIssues=false, reportOperatorIssue=false, reportAttributeAccessIssue=false
# pyright: reportCallIssue=false, reportIndexIssue=false, reportArgumentType=false, reportOptionalMemberAccess=false
from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from ...launch import launching
from ...projectors.voxels.triton_places import BLOCK, WARPS, places


def ascend(u: Tensor, q: Tensor, step: float, radius: float) -> None:
    """q [3, Z, Y, X] ← projection of `q + step ∇u` onto balls of `radius`; forward differences."""
    _require_plain(u, q)
    with launching(u):
        grid = (triton.cdiv(u.numel(), BLOCK),)
        _ascend[grid](u, q, *u.shape, float(step), float(radius), BLOCK, num_warps=WARPS)


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
        grid, numbers = (triton.cdiv(u.numel(), BLOCK),), (*u.shape, float(coupling), *bounds)
        _descend[grid](slope, tau, q, u, extrapolated, *numbers, BLOCK, num_warps=WARPS)


def _require_plain(*arrays: Tensor) -> None:
    assert all(array.dtype == torch.float32 and array.is_contiguous() for array in arrays)


@triton.jit
def _load(array, at, there):
    return tl.load(array + at, mask=there, other=0.0)


@triton.jit(do_not_specialize=["Z", "Y", "X"])
def _ascend(u, q, Z, Y, X, step, radius, BLOCK: tl.constexpr):
    at, z, y, x = places(tl.program_id(0), Y, X, BLOCK)
    there, plane = z < Z, Y.to(tl.int64) * X
    q1 = q + Z * plane
    q2 = q1 + Z * plane
    here = _load(u, at, there)
    # beyond the last voxel the difference is zero
    down = tl.where(z + 1 < Z, _load(u, at + plane, z + 1 < Z) - here, 0.0)
    side = tl.where(there & (y + 1 < Y), _load(u, at + X, there & (y + 1 < Y)) - here, 0.0)
    along = tl.where(there & (x + 1 < X), _load(u, at + 1, there & (x + 1 < X)) - here, 0.0)
    a, b, c = _load(q, at, there) + step * down, _load(q1, at, there) + step * side, _load(q2, at, there) + step * along
    # The tiny number keeps 0 / 0 away where there is no total variation at all.
    scale = radius / tl.maximum(tl.maximum(radius, tl.sqrt(a * a + b * b + c * c)), 1e-30)
    tl.store(q + at, a * scale, mask=there)
    tl.store(q1 + at, b * scale, mask=there)
    tl.store(q2 + at, c * scale, mask=there)


@triton.jit(do_not_specialize=["Z", "Y", "X"])
def _descend(slope, tau, q, u, extrapolated, Z, Y, X, coupling, lower, upper, BLOCK: tl.constexpr):
    at, z, y, x = places(tl.program_id(0), Y, X, BLOCK)
    there, plane = z < Z, Y.to(tl.int64) * X
    q1 = q + Z * plane
    q2 = q1 + Z * plane
    inflow = _load(q, at - plane, there & (z > 0)) + _load(q1, at - X, there & (y > 0))
    inflow += _load(q2, at - 1, there & (x > 0))
    divergence = inflow - _load(q, at, there) - _load(q1, at, there) - _load(q2, at, there)
    old = _load(u, at, there)
    moved = old - _load(tau, at, there) * (_load(slope, at, there) + coupling * divergence)
    fresh = tl.minimum(tl.maximum(moved, lower), upper)
    tl.store(extrapolated + at, 2 * fresh - old, mask=there)
    tl.store(u + at, fresh, mask=there)
