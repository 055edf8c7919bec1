"""Points to start from, for programs that want a cloud with their images: a visual hull, or the whole field."""

from __future__ import annotations

import numpy as np

from ..checks import require, shaped
from ..geometry import Grid, Views

FINEST = 64
"""Voxels along the longer side of the field of view in which a hull is looked for."""
SHADOW = 0.1
"""Share of the greatest thickness from which on a pixel counts as shadow."""
AGREEMENT = 0.9
"""Share of the views that must have a voxel in their shadow (one bad frame in many does no harm)."""


def uniform_points(views: Views, count: int, seed: int = 0) -> np.ndarray:
    """[count, 3] points (x, y, z) [m], even in the box that the detectors look at."""
    grid = Grid.of_views(views)
    extent = np.array(grid.voxel_size) * np.array(grid.shape[::-1])
    return grid.centre + extent * (np.random.default_rng(seed).random((count, 3)) - 0.5)


def hull_points(thickness: np.ndarray, views: Views, count: int, seed: int = 0) -> np.ndarray:
    """[count, 3] points (x, y, z) [m], evenly distributed in the visual hull of the shadows (Laurentini 1994).

    thickness: [V, H, W] retrieved line integrals of any scale; a shadow consists of the pixels above a tenth of their
    99.9th percentile. A voxel belongs to the hull if it lies in the shadow of nine tenths of the views.
    """
    shaped("thickness", thickness, (len(views), *views.shape))
    level = SHADOW * float(np.percentile(thickness, 99.9))
    require(level > 0, "the frames hold no shadow of the material; check it, or leave it away for points anywhere.")
    grid = Grid.of_views(views, refine=min(1.0, FINEST / max(views.shape)))
    z, y, x = np.meshgrid(*grid.axes()[::-1], indexing="ij")
    centres = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    dark = np.zeros(len(centres))
    for n, shadow in enumerate(thickness > level):
        inside, row, column = _pixels(centres, views, n)
        dark[inside] += shadow[row[inside], column[inside]]
    filled = np.flatnonzero(dark >= AGREEMENT * len(views))
    require(len(filled) > 0, "the views' shadows have no volume in common; check their poses, or leave the material.")
    random = np.random.default_rng(seed)
    return centres[random.choice(filled, count)] + np.array(grid.voxel_size) * (random.random((count, 3)) - 0.5)


def _pixels(points: np.ndarray, views: Views, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Whether view `n` sees points [P, 3] [m], and the (row, column) of the pixels [P] that they fall on."""
    lab = points @ views.rotations[n, :2].T - views.shifts[n]
    column, row = np.floor(lab / views.pixel_sizes[n] + 0.5 * np.array(views.shape[::-1])).astype(int).T
    h, w = views.shape
    return (row >= 0) & (row < h) & (column >= 0) & (column < w), row, column
