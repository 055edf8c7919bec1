"""Isotropic total variation of a volume, smoothed (Rudin et al. 1992), with its gradient.

Backends: `cpu` (C++, value and gradient in one pass, float32), `cuda` and `reference` (plain torch, any float type).
"""

from __future__ import annotations

from torch import Tensor

from ...backends import implementation


def total_variation(density: Tensor, smoothing: float = 0.02, backend: str = "reference") -> Tensor:
    """Mean over voxels of `sqrt(|∇u|² + s²) - s`: [C, Z, Y, X] → scalar, s = `smoothing`.

    Forward differences, over the voxels that have all three neighbours.
    """
    return implementation(__name__, backend).total_variation(density, smoothing)
