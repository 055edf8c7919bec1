"""Projectors: pure functions from an object's data and the views to line integrals along the beam.

One folder a method: its public, checked functions in `__init__.py`, a plain torch `reference.py` that is the
specification, and the fast twins beside it. Kernels work in pixels; whoever calls them scales in and out.

The rays of a cone meet in a source at `(0, 0, -R)` of the lab frame. What lies in the depth z is seen on the plane
`z = 0` at `(x, y) R / (R + z)`, and a ray that meets this plane at (u, v) is `√(1 + (u² + v²) / R²)` longer than the
depth that it crosses.
"""

from __future__ import annotations

import torch
from torch import Tensor


def obliquity(shape: tuple[int, int], pixel: Tensor, shift: Tensor, source: Tensor) -> Tensor:
    """Length over depth [H, W] of the rays of the pixels of a view; pixel, source: []; shift: [2], in one unit."""
    y, x = (
        pixel * (torch.arange(n, dtype=pixel.dtype, device=pixel.device) - 0.5 * (n - 1)) + at
        for n, at in zip(shape, (shift[1], shift[0]))
    )
    return (1 + (x.square() + y.square()[:, None]) / source.square()).sqrt()
