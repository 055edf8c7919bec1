"""Bubbles in a medium that fills the field: the union of balls, which may overlap, with exact line integrals.

Everything is said against the medium: outside the bubbles there is nothing to integrate, wherever the medium ends.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from ..checks import in_range, require
from ..geometry import Grid, Views
from ..matter import DeltaBeta
from ..volume import LineIntegrals, Volume
from .continuous import PER_VOXEL, RAYS
from .phantoms import Ball, packed_balls

Box = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Bubbles:
    """The union of `balls`, filled with `matter` against its medium; `InputError` if there are none."""

    balls: tuple[Ball, ...]
    matter: DeltaBeta

    def __post_init__(self) -> None:
        object.__setattr__(self, "balls", tuple(self.balls))
        require(len(self.balls) > 0, "a scene of bubbles needs at least one, but there is none.")

    @property
    def centres(self) -> np.ndarray:
        """`(x, y, z)` of each [N, 3] [m]."""
        return np.stack([ball.centre for ball in self.balls])

    @property
    def radii(self) -> np.ndarray:
        """Of each [N] [m]."""
        return np.array([0.5 * ball.diameter for ball in self.balls])

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner `(x, y, z)` [m] of all bubbles together."""
        centres, radii = self.centres, self.radii[:, None]
        return (centres - radii).min(axis=0), (centres + radii).max(axis=0)

    def at(self, time: float) -> Bubbles:
        """The scene itself: it does not move."""
        return self

    def missing_field(self, views: Views) -> float:
        """How far [m] a bubble reaches beyond the detector in the worst view (0 or less: all are seen whole)."""
        seen = np.einsum("vij,nj->vni", views.rotations, self.centres)[..., :2] - views.shifts[:, None]
        return float((np.abs(seen) + self.radii[:, None] - 0.5 * views.fields[:, None]).max())

    def project(self, views: Views) -> LineIntegrals:
        """Thickness of the union, [V, 1, H, W] float64 in metres: the mean of `RAYS`² exact ones a pixel."""
        fine, lines = views.refined(RAYS), np.empty((len(views), *views.shape))
        (h, w), (height, width) = views.shape, fine.shape
        for v, (rotation, (sx, sy), p) in enumerate(zip(fine.rotations, fine.shifts, fine.pixel_sizes)):
            x, y, depth = (rotation @ self.centres.T)[:, :, None, None]
            columns = (np.arange(width) + 0.5 - 0.5 * width) * p + sx
            rows = (np.arange(height) + 0.5 - 0.5 * height) * p + sy
            square = self.radii[:, None, None] ** 2 - (columns - x) ** 2 - (rows[:, None] - y) ** 2
            thickness = _covered(np.broadcast_to(depth, square.shape), np.sqrt(np.maximum(square, 0)))
            lines[v] = thickness.reshape(h, RAYS, w, RAYS).mean(axis=(1, 3))
        return LineIntegrals(torch.from_numpy(lines[:, None]), (tuple(self.matter),))  # type: ignore[arg-type]

    def voxelise(self, grid: Grid) -> Volume:
        """δ and β against the medium, averaged over voxels, from `PER_VOXEL`³ points of each."""
        share, (nz, ny, nx) = np.zeros(grid.shape), grid.shape
        inside = (np.arange(PER_VOXEL) + 0.5) / PER_VOXEL - 0.5
        x, y, z = ((at[:, None] + d * inside).ravel() for at, d in zip(grid.axes(), grid.voxel_size))
        cells = (1, PER_VOXEL, ny, PER_VOXEL, nx, PER_VOXEL)
        for k in range(nz):
            layer = z[k * PER_VOXEL : (k + 1) * PER_VOXEL]
            full = np.zeros((PER_VOXEL, len(y), len(x)), dtype=bool)
            for (cx, cy, cz), radius in zip(self.centres, self.radii):
                left = radius**2 - (layer - cz) ** 2
                if (left > 0).any():
                    away = (y[:, None] - cy) ** 2 + (x - cx) ** 2
                    full |= away < left[:, None, None]
            share[k] = full.reshape(cells).mean(axis=(0, 1, 3, 5))
        return Volume(self.matter.delta * share, self.matter.beta * share, grid)


def random_bubbles(
    count: int,
    radii: tuple[float, float],
    box: Box,
    matter: DeltaBeta,
    seed: int = 0,
    *,
    overlapping: bool = False,
) -> Bubbles:
    """`count` bubbles at random in a cylinder about y of extents `box` [m], filled with `matter` against its medium.

    radii: the smallest and the largest [m], between which the others lie evenly; overlapping: whether bubbles may
    overlap, as those that merge; else they do not touch. `InputError` where they do not fit.
    """
    require(count >= 1, f"count must be at least 1, but it is {count}.")
    low, high = (2 * in_range("radius of bubbles", r, 1e-9, 0.5, unit="metres") for r in radii)
    require(low <= high, f"radii must be (smallest, largest), but they are {radii[0]:g} and {radii[1]:g} m.")
    rng, sizes = np.random.default_rng(seed), np.linspace(high, low, count)
    if overlapping:
        return Bubbles(tuple(packed_balls(sizes[[i]], box, rng)[0] for i in range(count)), matter)
    return Bubbles(tuple(packed_balls(sizes, box, rng, margin=0.02 * low)), matter)


def _covered(middles: np.ndarray, halves: np.ndarray) -> np.ndarray:
    """Length [...] of the union of the intervals `middles ± halves`, both [N, ...]."""
    order = np.argsort(middles - halves, axis=0)
    first, last = (np.take_along_axis(ends, order, axis=0) for ends in (middles - halves, middles + halves))
    reached = np.maximum.accumulate(last, axis=0)
    new = np.concatenate([last[:1] - first[:1], reached[1:] - np.maximum(reached[:-1], first[1:])])
    return np.where(last > first, np.maximum(new, 0), 0.0).sum(axis=0)
