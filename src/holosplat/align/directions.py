"""Poorly determined directions of pose space in words: the widest of the covariances, relative to the prior."""

from __future__ import annotations

import torch
from torch import Tensor

from .derivatives import NUMBERS

HARDLY = 0.3
"""A direction is hardly told if more than this part of its prior standard deviation is left."""
SHARES = 0.35
"""A number belongs to a direction if it has this part of it, in units of its own prior deviation."""


def hardly_told(covariances: Tensor, expected: Tensor) -> list[str]:
    """Describe each direction of pose space that some views hardly determine, given the matter.

    covariances: [V, K, K] of `NUMBERS`, prior included; expected: [K] prior standard deviations, 0 for what stays.
    Numbers are taken in units of these, so that an undetermined direction has the variance 1.
    """
    free = torch.nonzero(expected > 0)[:, 0]
    units = expected[free]
    scaled = covariances[:, free][:, :, free] / (units[:, None] * units)
    values, ways = torch.linalg.eigh(scaled)
    found = dict[str, list[tuple[int, float]]]()
    for view in range(len(covariances)):
        left, way = float(values[view, -1].clamp_min(0).sqrt()), ways[view, :, -1]
        if left > HARDLY:
            parts = [NUMBERS[int(free[k])] for k in torch.nonzero(way.abs() >= SHARES)[:, 0]]
            found.setdefault(" with ".join(parts), []).append((view, left))
    return [
        f"hardly told: {name}, in views {', '.join(str(view) for view, _ in views)} "
        f"({max(left for _, left in views):.0%} of what was uncertain is left)"
        for name, views in found.items()
    ]
