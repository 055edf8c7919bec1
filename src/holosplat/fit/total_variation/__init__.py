"""Isotropic total variation of a volume, smoothed (Rudin et al. 1992), with its gradient.

Backends: `cpu` (C++, value and gradient in one pass, float32), `cuda` and `reference` (plain torch, any float type).
"""

from __future__ import annotations

import torch
from torch import Tensor

from ...backends import implementation
from ...checks import require


def total_variation(density: Tensor, smoothing: float = 0.02, backend: str = "reference") -> Tensor:
    """Mean over voxels of `sqrt(|∇u|² + s²) - s`: [C, Z, Y, X] → scalar, s = `smoothing`.

    Forward differences, over the voxels that have all three neighbours; an axis of one voxel has no part in it.
    Errors: `InputError` for another shape, or a type that the backend does not compute in.
    """
    require(
        density.ndim == 4 and min(density.shape) > 0,
        f"density must have the shape [C, Z, Y, X], none of them zero, but it has {tuple(density.shape)}.",
    )
    require(
        backend == "reference" or density.dtype == torch.float32,
        f"density must be float32 for the {backend} backend, but it is {density.dtype}; use .float().",
    )
    for axis in (1, 2, 3):
        if density.shape[axis] == 1:  # nothing changes along it: as two equal layers
            density = density.repeat_interleave(2, axis)
    return implementation(__name__, backend).total_variation(density, smoothing)
