"""Derivatives of functions of space and time by automatic differentiation, for comparison."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from holosplat_bench.opponents.fields.perceptron import Jet

Function = Callable[[Tensor], Tensor]
"""Of points [P, 4] `(x, y, z, t)`, each by itself: values [P, C], or [P]."""


def slopes(function: Function, at: Tensor) -> Tensor:
    """∂/∂(x, y, z, t) [P, C, 4] or [P, 4] of `function` at the points `at`, differentiable."""
    at = at if at.requires_grad else at.clone().requires_grad_()
    values = function(at)
    return _one(values, at) if values.ndim == 1 else torch.stack([_one(value, at) for value in values.unbind(1)], 1)


def jet_of(function: Function, at: Tensor) -> Jet:
    """`function` at the points `at` [P, 4]."""
    at = at.clone().requires_grad_()
    every = slopes(function, at)
    flat = every.reshape(len(at), -1, 4)
    second = [sum(_one(flat[:, c, k], at)[:, k] for k in range(3)) for c in range(flat.shape[1])]
    curved = torch.stack(second, 1).reshape(every.shape[:-1])  # pyright: ignore[reportArgumentType]
    return Jet(function(at).detach(), every[..., :3].detach(), every[..., 3].detach(), curved.detach())


def curl(potential: Function) -> Function:
    """∇ × A of a function A with three values."""

    def found(at: Tensor) -> Tensor:
        slope = slopes(potential, at)
        pairs = ((2, 1, 1, 2), (0, 2, 2, 0), (1, 0, 0, 1))
        return torch.stack([slope[:, a, b] - slope[:, c, d] for a, b, c, d in pairs], 1)

    return found


def _one(value: Tensor, at: Tensor) -> Tensor:
    if not value.requires_grad:
        return torch.zeros_like(at)
    (found,) = torch.autograd.grad(value.sum(), at, create_graph=True, allow_unused=True)
    return torch.zeros_like(at) if found is None else found
