"""Adam in plain torch: the specification, in any float type, on any device."""

from __future__ import annotations

from torch import Tensor


def step(
    parameters: list[Tensor], gradients: list[Tensor], first: list[Tensor], second: list[Tensor], factors: Tensor
) -> None:
    """One step in place; as the package's `step`."""
    for p, g, m, v, factor in zip(parameters, gradients, first, second, factors[:-1]):
        m += 0.1 * (g - m)
        v += 0.001 * (g * g - v)
        p -= factor * m / (v.sqrt() + factors[-1])
