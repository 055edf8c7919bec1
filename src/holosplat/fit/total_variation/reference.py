"""Total variation in plain torch: the specification, in any float type, on any device."""

from __future__ import annotations

from torch import Tensor


def total_variation(density: Tensor, smoothing: float) -> Tensor:
    """[C, Z, Y, X] → scalar; as the package's `total_variation`."""
    core = density[:, :-1, :-1, :-1]
    square = (density[:, 1:, :-1, :-1] - core).square()
    square = square + (density[:, :-1, 1:, :-1] - core).square()
    square = square + (density[:, :-1, :-1, 1:] - core).square()
    return ((square + smoothing**2).sqrt() - smoothing).mean()
