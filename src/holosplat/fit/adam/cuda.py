"""Adam on the GPU: one Triton launch for every four arrays."""

from __future__ import annotations

from torch import Tensor

from ...launch import launching
from . import triton_adam


def step(
    parameters: list[Tensor], gradients: list[Tensor], first: list[Tensor], second: list[Tensor], factors: Tensor
) -> None:
    """One step of Adam on K float32 arrays, in place; arguments as the package's `step`, already checked.

    `parameter -= factors[k] · first / (√second + factors[-1])`, after `first` and `second` have moved towards the
    gradient (by 0.1) and its square (by 0.001). factors: float32, on the device; nothing waits for it.
    """
    with launching(factors):
        triton_adam.step(parameters, [g.contiguous() for g in gradients], first, second, factors)
