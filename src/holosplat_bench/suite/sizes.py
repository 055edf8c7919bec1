"""How much of the contrast of small things is left: of balls, by their size."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from holosplat.specimens.phantoms import Ball
from holosplat.volume import Volume

HALF_DIAGONAL = 0.5 * np.sqrt(3.0)
"""From a voxel's centre to its corner, in voxels: a ball of this radius holds a voxel's centre wherever it lies."""


def contrast_by_size(found: Volume, truth: Volume, balls: Sequence[Ball]) -> tuple[np.ndarray, np.ndarray]:
    """Diameters [S] [m], falling, and the contrast [S] of the balls of each, as a part of the true one.

    A ball's contrast is the mean δ within it, less the mean δ in the shell around it as wide as its radius; both
    volumes lie on one grid of cubic voxels. 1: all of it is left; 0: nothing is seen.
    """
    contrast = np.array([[_contrast(volume, ball) for volume in (found, truth)] for ball in balls])
    diameters = np.array([ball.diameter for ball in balls])
    sizes = np.unique(diameters)[::-1]
    sums = np.stack([contrast[diameters == size].sum(axis=0) for size in sizes])
    return sizes, sums[:, 0] / sums[:, 1]


def _contrast(volume: Volume, ball: Ball) -> float:
    """Mean δ in `ball` less that around it; with room for the blur of a voxel between the two."""
    pitch, radius = volume.grid.voxel_size[0], 0.5 * ball.diameter
    reach = max(2 * radius, radius + 1.5 * pitch)
    near = [np.flatnonzero(np.abs(axis - c) <= reach) for axis, c in zip(volume.grid.axes(), ball.centre)]
    x, y, z = (axis[i] - c for axis, i, c in zip(volume.grid.axes(), near, ball.centre))
    distance = np.sqrt(z[:, None, None] ** 2 + y[None, :, None] ** 2 + x[None, None, :] ** 2)
    values = volume.delta[np.ix_(near[2], near[1], near[0])].astype(np.float64)
    inside = distance <= max(radius, HALF_DIAGONAL * pitch)
    around = (distance > radius + 0.5 * pitch) & (distance <= reach)
    return float(values[inside].mean() - values[around].mean())
