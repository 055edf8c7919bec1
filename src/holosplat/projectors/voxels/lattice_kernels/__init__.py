"""Line integrals of voxels, their adjoints, and gradients of poses; `..lattice` is made of them.

Backends: `cpu` (C++), `cuda` (Triton), `reference`, each with a class `Kernels`, the hats of a lattice on a detector,
and a class `Stack`, rays through slices.
"""

from __future__ import annotations

from typing import NamedTuple

KINK = 1e-6
"""Pixels from a pixel's centre within which a voxel counts as lying on it."""
SLACK = 1e-6
"""Pixels by which a voxel may lie beyond the centres of the outermost pixels."""


class Lattice(NamedTuple):
    """Voxels and the raster that they are seen on.

    shape: `(Z, Y, X)` voxels.
    origin: centre `(x, y, z)` [px] of voxel [0, 0, 0].
    pitch: edges `(dx, dy, dz)` [px].
    raster: `(H, W)` pixels.
    """

    shape: tuple[int, int, int]
    origin: tuple[float, float, float]
    pitch: tuple[float, float, float]
    raster: tuple[int, int]
