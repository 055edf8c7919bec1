"""Adam (Kingma & Ba 2015) with β = 0.9, 0.999: one step over any number of arrays, each at its own rate.

Backends: `cpu` (C++, float32), `cuda` (Triton, float32) and `reference` (plain torch, any float type), which is the
specification of the others.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from ...backends import implementation
from ...checks import require

BETAS = (0.9, 0.999)
"""Decay of the running means of the gradient and of its square."""


def factors(rates: Sequence[float], count: int, epsilon: float) -> Tensor:
    """What `step` multiplies by in step `count` (from 1): [K + 1] float32, for the rates of K arrays.

    The bias corrections of Kingma & Ba (2015), end of section 2: `rate √(1 - β₂ᵗ) / (1 - β₁ᵗ)`; last `ε √(1 - β₂ᵗ)`.
    """
    first, second = (1 - beta**count for beta in BETAS)
    scale = math.sqrt(second)
    return torch.tensor([*(rate * scale / first for rate in rates), epsilon * scale], dtype=torch.float32)


def step(
    parameters: list[Tensor],
    gradients: list[Tensor],
    first: list[Tensor],
    second: list[Tensor],
    factors: Tensor,
    backend: str = "cpu",
) -> None:
    """One step on K arrays, in place: `parameter -= factors[k] · first / (√second + factors[-1])`.

    Before that, `first` and `second`, the running means, move towards the gradient (by 0.1 of the way) and its square
    (by 0.001). The arrays of one k have one shape, and are contiguous, except the gradients; factors: [K + 1], of
    the function of that name. Errors: `InputError` if the arrays do not fit together, or the backend.
    """
    groups = (parameters, gradients, first, second)
    counts = [len(factors) - 1, *(len(arrays) for arrays in groups)]
    require(len(set(counts)) == 1, f"Adam needs one of each for every parameter, but there are {counts}.")
    for p, *others in zip(*groups):
        alike = all((a.shape, a.dtype, a.device) == (p.shape, p.dtype, p.device) for a in others)
        require(alike, "a parameter's gradient and running means must have its shape, type and device.")
        moved = (p, *others[1:])
        require(
            backend == "reference" or (p.dtype == torch.float32 and all(a.is_contiguous() for a in moved)),
            f"parameters and running means must be float32 and contiguous for the {backend} backend.",
        )
    require(
        backend == "reference" or factors.dtype == torch.float32,
        f"Adam's factors must be float32 for the {backend} backend, but they are {factors.dtype}.",
    )
    implementation(__name__, backend).step(*groups, factors)
