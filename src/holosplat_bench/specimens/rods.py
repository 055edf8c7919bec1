"""Unions of round-ended rods and balls of one material, with exact line integrals: bubbles, lattices, fibres.

Everything is said against the medium: outside the rods there is nothing to integrate, wherever the medium ends.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from holosplat.checks import finite, in_range, require, shaped
from holosplat.frames import block_means
from holosplat.geometry import Grid, Views
from holosplat.matter import DeltaBeta
from holosplat.specimens.continuous import PER_VOXEL, RAYS
from holosplat.specimens.phantoms import Ball, packed_balls
from holosplat.volume import LineIntegrals, Unmoved, Volume

Box = tuple[float, float, float]
TILE = 32
"""Rays along a tile's edge; a tile considers the rods that touch it, and no others."""
PARALLEL = 1e-12
"""Squared sine of the angle between a rod and the beam below which they are parallel."""


@dataclass(frozen=True, eq=False)
class Rod:
    """A cylinder with a half ball at each end: all points within `radius` [m] of a straight line.

    start, end: [3] ends of the line `(x, y, z)` [m]; equal ends make a ball. Errors: `InputError` for ends of another
    shape, and for a radius out of range.
    """

    start: np.ndarray
    end: np.ndarray
    radius: float

    def __post_init__(self) -> None:
        for name in ("start", "end"):
            array = shaped(f"{name} of a rod", np.asarray(getattr(self, name), dtype=np.float64), (3,))
            object.__setattr__(self, name, finite(f"{name} of a rod", array))
        in_range("radius of a rod", self.radius, 1e-10, 0.5, unit="metres")

    @property
    def volume(self) -> float:
        """`π r² L + 4π r³/3` [m³]."""
        length = float(np.linalg.norm(self.end - self.start))
        return np.pi * self.radius**2 * (length + 4 / 3 * self.radius)


@dataclass(frozen=True, eq=False)
class RodScene(Unmoved):
    """The union of `rods`, filled with `matter` against its medium: what overlaps counts once.

    Errors: `InputError` if there are none.
    """

    rods: tuple[Rod, ...]
    matter: DeltaBeta

    @classmethod
    def of_balls(cls, balls: Sequence[Ball], matter: DeltaBeta) -> RodScene:
        """The union of balls."""
        return cls(tuple(Rod(ball.centre, ball.centre, 0.5 * ball.diameter) for ball in balls), matter)

    def __post_init__(self) -> None:
        object.__setattr__(self, "rods", tuple(self.rods))
        require(len(self.rods) > 0, "a scene of rods or bubbles needs at least one, but there is none.")

    @property
    def ends(self) -> np.ndarray:
        """`(x, y, z)` of both ends of each rod [N, 2, 3] [m]."""
        return np.array([(rod.start, rod.end) for rod in self.rods])

    @property
    def radii(self) -> np.ndarray:
        """Of each rod [N] [m]."""
        return np.array([rod.radius for rod in self.rods])

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner `(x, y, z)` [m] of all rods together."""
        ends, radii = self.ends, self.radii[:, None, None]
        return (ends - radii).min(axis=(0, 1)), (ends + radii).max(axis=(0, 1))

    def missing_field(self, views: Views) -> float:
        """How far [m] a rod reaches beyond the detector in the worst view (0 or less: all are seen whole)."""
        seen = np.einsum("vij,nej->vnei", views.rotations, self.ends)[..., :2] - views.shifts[:, None, None]
        half = 0.5 * views.fields[:, None, None]
        return float((np.abs(seen) + self.radii[:, None, None] - half).max())

    def project(self, views: Views) -> LineIntegrals:
        """Thickness of the union, [V, 1, H, W] float64 in metres: the mean of `RAYS`² exact ones a pixel."""
        views.parallel("a specimen of rods")
        fine, lines = views.refined(RAYS), np.zeros((len(views), *views.refined(RAYS).shape))
        height, width = fine.shape
        for v, (rotation, (sx, sy), p) in enumerate(zip(fine.rotations, fine.shifts, fine.pixel_sizes)):
            ends = self.ends @ rotation.T
            columns = (np.arange(width) + 0.5 - 0.5 * width) * p + sx
            rows = (np.arange(height) + 0.5 - 0.5 * height) * p + sy
            low = ends.min(axis=1)[:, :2] - self.radii[:, None]
            high = ends.max(axis=1)[:, :2] + self.radii[:, None]
            for top in range(0, height, TILE):
                y = rows[top : top + TILE]
                in_rows = (low[:, 1] <= y[-1]) & (high[:, 1] >= y[0])
                for left in range(0, width, TILE):
                    x = columns[left : left + TILE]
                    near = in_rows & (low[:, 0] <= x[-1]) & (high[:, 0] >= x[0])
                    if near.any():
                        found = [_interval(e, r, x, y[:, None]) for e, r in zip(ends[near], self.radii[near])]
                        lines[v, top : top + TILE, left : left + TILE] = _covered(*map(np.stack, zip(*found)))
        means = torch.from_numpy(block_means(lines, RAYS)[:, None])
        return LineIntegrals(means, (tuple(self.matter),))  # type: ignore[arg-type]

    def voxelise(self, grid: Grid) -> Volume:
        """δ and β against the medium, averaged over voxels, from `PER_VOXEL`³ points of each."""
        share, (nz, ny, nx) = np.zeros(grid.shape), grid.shape
        x, y, z = grid.divided((PER_VOXEL, PER_VOXEL, PER_VOXEL)).axes()
        cells = (1, PER_VOXEL, ny, PER_VOXEL, nx, PER_VOXEL)
        for k in range(nz):
            layer = z[k * PER_VOXEL : (k + 1) * PER_VOXEL]
            full = np.zeros((PER_VOXEL, len(y), len(x)), dtype=bool)
            for rod in self.rods:
                box = _box(rod, layer[0], layer[-1])
                if box is not None:
                    rows, columns = (slice(*np.searchsorted(at, box[:, axis])) for axis, at in ((1, y), (0, x)))
                    full[:, rows, columns] |= _within(rod, x[columns], y[rows, None], layer[:, None, None])
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
) -> RodScene:
    """`count` bubbles at random in a cylinder about y of extents `box` [m], filled with `matter` against its medium.

    radii: the smallest and the largest [m], between which the others lie evenly; overlapping: whether bubbles may
    overlap, as those that merge; else they do not touch. `InputError` where they do not fit.
    """
    require(count >= 1, f"count must be at least 1, but it is {count}.")
    low, high = (2 * in_range("radius of bubbles", r, 1e-9, 0.5, unit="metres") for r in radii)
    require(low <= high, f"radii must be (smallest, largest), but they are {radii[0]:g} and {radii[1]:g} m.")
    rng, sizes = np.random.default_rng(seed), np.linspace(high, low, count)
    if overlapping:
        return RodScene.of_balls([packed_balls(sizes[[i]], box, rng)[0] for i in range(count)], matter)
    return RodScene.of_balls(packed_balls(sizes, box, rng, margin=0.02 * low), matter)


def _interval(ends: np.ndarray, radius: float, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where rays along z at `x`, `y` [m] enter and leave a rod: two arrays of their common shape; 0 and 0 for a miss.

    ends: [2, 3]. A rod is convex, so that the intervals in its cylinder and in its balls make one.
    """
    found = [_ball_interval(end, radius, x, y) for end in ends]
    if (length := float(np.linalg.norm(ends[1] - ends[0]))) > 0:
        found.append(_cylinder_interval(ends[0], (ends[1] - ends[0]) / length, length, radius, x - 0 * y, y - 0 * x))
    first, last = np.min([f for f, _ in found], axis=0), np.max([one for _, one in found], axis=0)
    hit = last > first
    return np.where(hit, first, 0.0), np.where(hit, last, 0.0)


def _ball_interval(centre: np.ndarray, radius: float, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where rays enter and leave a ball; inf and -inf for a miss."""
    square = radius**2 - (x - centre[0]) ** 2 - (y - centre[1]) ** 2
    half = np.sqrt(np.maximum(square, 0))
    return np.where(square > 0, centre[2] - half, np.inf), np.where(square > 0, centre[2] + half, -np.inf)


def _cylinder_interval(
    start: np.ndarray, way: np.ndarray, length: float, radius: float, x: np.ndarray, y: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Where rays enter and leave the cylinder from `start` along the unit vector `way`; inf and -inf for a miss."""
    dx, dy = x - start[0], y - start[1]
    along = dx * way[0] + dy * way[1]  # of the ray's point at the start's depth
    a, b, c = 1 - way[2] ** 2, -along * way[2], dx * dx + dy * dy - along * along - radius**2
    if a > PARALLEL:
        root = b * b - a * c
        half, middle = np.sqrt(np.maximum(root, 0)) / a, -b / a
        first, last = np.where(root > 0, middle - half, np.inf), np.where(root > 0, middle + half, -np.inf)
    else:
        first, last = np.where(c < 0, -np.inf, np.inf), np.where(c < 0, np.inf, -np.inf)
    if abs(way[2]) > PARALLEL:
        one, other = -along / way[2], (length - along) / way[2]
        first, last = np.maximum(first, np.minimum(one, other)), np.minimum(last, np.maximum(one, other))
        miss = last <= first
    else:
        miss = (along < 0) | (along > length) | (last <= first)
    return np.where(miss, np.inf, start[2] + first), np.where(miss, -np.inf, start[2] + last)


def _box(rod: Rod, near: float, far: float) -> np.ndarray | None:
    """Corners [2, 2] (x, y) of the part of a rod between the depths `near` and `far`; None where it has none."""
    way, reach = rod.end - rod.start, np.array([near - rod.radius, far + rod.radius]) - rod.start[2]
    if way[2] == 0:
        share = np.array([0.0, 1.0])
        if reach[0] > 0 or reach[1] < 0:
            return None
    else:
        share = np.sort(reach / way[2])
        if share[0] > 1 or share[1] < 0:
            return None
    ends = rod.start + np.clip(share, 0, 1)[:, None] * way
    return np.stack([ends.min(axis=0) - rod.radius, ends.max(axis=0) + rod.radius])[:, :2]


def _within(rod: Rod, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Whether the points `x`, `y`, `z` [m], arrays that broadcast, lie in a rod."""
    way = rod.end - rod.start
    dx, dy, dz = x - rod.start[0], y - rod.start[1], z - rod.start[2]
    square = float(way @ way)
    if square > 0:
        t = np.clip((dx * way[0] + dy * way[1] + dz * way[2]) / square, 0, 1)
        dx, dy, dz = dx - t * way[0], dy - t * way[1], dz - t * way[2]
    return dx * dx + dy * dy + dz * dz < rod.radius**2


def _covered(first: np.ndarray, last: np.ndarray) -> np.ndarray:
    """Length [...] of the union of the intervals from `first` to `last`, both [N, ...]."""
    order = np.argsort(first, axis=0)
    first, last = (np.take_along_axis(ends, order, axis=0) for ends in (first, last))
    reached = np.maximum.accumulate(last, axis=0)
    new = np.concatenate([last[:1] - first[:1], reached[1:] - np.maximum(reached[:-1], first[1:])])
    return np.where(last > first, np.maximum(new, 0), 0.0).sum(axis=0)
