"""Half-steps of total variation in plain torch, any float type: volumes [Z, Y, X], changed in place."""

from __future__ import annotations

import torch
from torch import Tensor


def ascend(u: Tensor, q: Tensor, step: float, radius: float) -> None:
    """q [3, Z, Y, X] ← projection of `q + step ∇u` onto balls of `radius`; forward differences."""
    for axis, component in enumerate(q):
        length = u.shape[axis] - 1
        component.narrow(axis, 0, length).add_(step * u.diff(dim=axis))
    q /= (q.norm(dim=0) / radius).clamp_min(1) if radius > 0 else torch.inf


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
    divergence = torch.zeros_like(u)  # ∇ᵀq = q[i-1] - q[i] along each axis
    for axis, component in enumerate(q):
        length = u.shape[axis] - 1
        inner = component.narrow(axis, 0, length)
        divergence.narrow(axis, 1, length).add_(inner)
        divergence.narrow(axis, 0, length).sub_(inner)
    moved = (u - tau * (slope + coupling * divergence)).clamp(*bounds)
    torch.sub(2 * moved, u, out=extrapolated)
    u.copy_(moved)
