"""Matter: the `Volume` on a grid, and the `Object` protocol that every model of matter answers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
import torch

from .checks import finite, shaped
from .geometry import Grid, Views


@dataclass(frozen=True)
class Volume:
    """δ and β on a grid: delta, beta [Z, Y, X] float32, dimensionless (n = 1 - δ + iβ)."""

    delta: np.ndarray
    beta: np.ndarray
    grid: Grid

    def __post_init__(self) -> None:
        for name in ("delta", "beta"):
            array = np.ascontiguousarray(getattr(self, name), dtype=np.float32)
            object.__setattr__(self, name, finite(name, shaped(name, array, self.grid.shape)))


@runtime_checkable
class Object(Protocol):
    """Anything made of matter: mesh scenes, voxel volumes, Gaussian clouds, and whatever moves."""

    def at(self, time: float) -> Object:
        """The object as it is at `time` [s]; a static one returns itself."""
        ...

    def project(self, views: Views) -> tuple[torch.Tensor, torch.Tensor]:
        """Line integrals `(B, D)` of β and δ along the beam, each [V, H, W] in metres."""
        ...

    def voxelise(self, grid: Grid) -> Volume:
        """δ and β averaged over (or sampled on) the voxels of `grid`."""
        ...
