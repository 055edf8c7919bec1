"""From a matrix that makes a Gaussian of the unit ball to its axes: their lengths and their directions."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

ALIKE = 1e-3
"""Relative difference of two variances below which a turn within their plane gives a gradient no longer: it changes
nothing there."""


def quaternions_of(turns: Tensor) -> Tensor:
    """Quaternions [N, 4] `(w, x, y, z)` of rotation matrices [N, 3, 3], of length one.

    Of the four ways to divide, the one with the largest divisor (Shepperd 1978, J. Guidance and Control 1, 223).
    """
    m = turns.double()
    trace = m.diagonal(dim1=1, dim2=2).sum(1)
    squares = torch.stack([1 + trace, *(1 - trace + 2 * m[:, k, k] for k in range(3))], 1)
    off = torch.stack([m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1]], 1)
    sums = torch.stack([m[:, 0, 1] + m[:, 1, 0], m[:, 0, 2] + m[:, 2, 0], m[:, 1, 2] + m[:, 2, 1]], 1)
    a, b, c = off.unbind(1)
    p, q, r = sums.unbind(1)
    s = squares.unbind(1)
    rows = torch.stack(
        [
            torch.stack([s[0], a, b, c], 1),
            torch.stack([a, s[1], p, q], 1),
            torch.stack([b, p, s[2], r], 1),
            torch.stack([c, q, r, s[3]], 1),
        ],
        1,
    )
    best = rows[torch.arange(len(m), device=m.device), squares.argmax(1)]
    return (best / best.norm(dim=1, keepdim=True)).to(turns)


def principal_axes(shapes: Tensor) -> tuple[Tensor, Tensor]:
    """Logarithms of the semi-axes [N, 3] and quaternions [N, 4] of Gaussians of the covariance `M Mᵀ`, M [N, 3, 3].

    Differentiable: a change dΣ changes a length by `uᵀ dΣ u / 2s²`, and turns two axes in their plane by
    `uᵀ dΣ v / (s_v² - s_u²)` (perturbation of eigenvectors).
    """
    covariance = shapes @ shapes.mT
    return _Principal.apply(covariance)  # type: ignore[no-any-return]


class _Principal(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, covariance: Tensor) -> tuple[Tensor, Tensor]:  # type: ignore[override]
        values, axes = torch.linalg.eigh(covariance.detach().double())
        axes = axes * torch.linalg.det(axes).sign()[:, None, None]
        quaternions = quaternions_of(axes)
        ctx.save_for_backward(values, axes, quaternions)
        return 0.5 * values.clamp_min(1e-300).log().to(covariance), quaternions.to(covariance)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_logs: Tensor, by_quaternions: Tensor) -> Tensor:  # type: ignore[override]
        values, axes, q = ctx.saved_tensors
        g = by_quaternions.double()
        w, x, y, z = q.double().unbind(1)
        a, b, c, d = g.unbind(1)
        # A small turn ω about the Gaussian's own axes is q ∘ (1, ω/2).
        turns = 0.5 * torch.stack(
            [
                -x * a + w * b + z * c - y * d,
                -y * a - z * b + w * c + x * d,
                -z * a + y * b - x * c + w * d,
            ],
            1,
        )
        own = torch.diag_embed(by_logs.double() / (2 * values))
        for k, (i, j) in enumerate(((1, 2), (2, 0), (0, 1))):
            apart = values[:, j] - values[:, i]
            softened = apart**2 + (ALIKE * (values[:, i] + values[:, j])) ** 2
            part = 0.5 * turns[:, k] * apart / softened
            own[:, i, j] += -part
            own[:, j, i] += -part
        return (axes @ own @ axes.mT).to(by_logs)
