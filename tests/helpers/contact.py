"""Frames of balls in contact, from chords: no numerics shared with what reconstructs them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from holosplat.geometry import Grid, Views
from holosplat.scan import Exposures, Scan
from holosplat.units import wavenumber
from holosplat.volume import Volume

ENERGY = 20.0
PIXEL = 2e-6
FINE = 4
"""Rays along a pixel's edge."""

Ball = tuple[float, float, float, float, float]
"""x, y, z and radius [pixels], and β."""


def turned(count: int, shape: tuple[int, int]) -> Views:
    """Views over 180° about y."""
    return Views.from_angles(np.arange(count) * 180.0 / count, shape, PIXEL)


def contact_scan(
    balls: Sequence[Ball], shape: tuple[int, int], count: int = 12, photons: float | None = None, test_every: int = 4
) -> Scan:
    """A scan at distance 0; every `test_every`-th view is held out."""
    views, (h, w) = turned(count, shape), shape
    x, y = ((np.arange(n * FINE) + 0.5) / FINE - n / 2 for n in (w, h))
    frames = np.empty((count, h, w))
    for v, rotation in enumerate(views.rotations):
        loss = np.zeros((h * FINE, w * FINE))
        for *centre, radius, beta in balls:
            cx, cy, _ = rotation @ np.array(centre)
            chord = 2 * np.sqrt(np.clip(radius**2 - (x - cx) ** 2 - (y[:, None] - cy) ** 2, 0, None))
            loss += 2 * wavenumber(ENERGY) * beta * PIXEL * chord
        frames[v] = np.exp(-loss).reshape(h, FINE, w, FINE).mean((1, 3))
    if photons is not None:
        frames = np.random.default_rng(0).poisson(frames * photons) / photons
    held_out = np.arange(count) % test_every == test_every - 1
    return Scan(frames.astype(np.float32), Exposures.of(views, ENERGY, 0.0), held_out)


def inside(grid: Grid, ball: Ball, share: float = 1.0) -> np.ndarray:
    """[Z, Y, X] bool: voxels within `share` of the ball's radius."""
    x, y, z = (axis / PIXEL for axis in grid.axes())
    cx, cy, cz, radius, _ = ball
    return (x - cx) ** 2 + (y[:, None] - cy) ** 2 + (z[:, None, None] - cz) ** 2 < (share * radius) ** 2


def mean_beta(volume: Volume, ball: Ball, share: float = 0.75) -> float:
    """Mean β well inside the ball, over the ball's own."""
    return float(volume.beta[inside(volume.grid, ball, share)].mean()) / ball[4]


def transmission(beta: float, thickness: float) -> float:
    """Share of the light that passes `thickness` [m] of matter with β = `beta`."""
    return float(np.exp(-2 * wavenumber(ENERGY) * beta * thickness))
