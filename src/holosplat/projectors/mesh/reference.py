"""Scan conversion of triangles in float64 numpy: which rays hit which face, and how deep.

Rays sit at integer coordinates of a lattice. Rows and spans are half-open and every edge is evaluated from its
lower to its upper end, so neighbouring faces compute the same crossing and each ray of a closed surface is
counted exactly once (no cracks, no doubles).
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ...geometry import Grid

MAX_HITS = 4_000_000
"""Hits held in memory at once."""

NUDGE = (3.1e-8, 7.3e-8)
"""Lattice offset (columns, rows): keeps rays off vertices of axis-aligned bodies; far below any accuracy."""


def mean_depths(
    lab: np.ndarray,
    faces: np.ndarray,
    values: np.ndarray,
    shape: tuple[int, int],
    pitch: float,
    rays: int,
    bent: float = 0.0,
) -> np.ndarray:
    """[C, H, W] float64: Σ over hits of `sign · z · value`, the mean over the `rays × rays` rays of each pixel.

    lab: [P, 3] vertices [m], over `1 + bent z`; shape: pixels (H, W) of `pitch` [m]; bent: one over the source's
    distance [1/m].
    """
    (h, w), fine = shape, (shape[0] * rays, shape[1] * rays)
    u = rays * lab[:, 0] / pitch + 0.5 * (fine[1] - 1) + NUDGE[0]
    v = rays * lab[:, 1] / pitch + 0.5 * (fine[0] - 1) + NUDGE[1]
    out = np.zeros((len(values), h * w))
    for ray, z, sign, face in ray_hits(np.stack([u, v, lab[:, 2]], 1), faces, fine):
        row, column = ray // fine[1], ray % fine[1]
        pixel = row // rays * w + column // rays  # at once: the raster of all rays would not fit the caches
        first, last = pixel.min(initial=h * w), pixel.max(initial=0)
        count = max(last - first + 1, 0)
        for c, value in enumerate(values):
            out[c, first : last + 1] += np.bincount(pixel - first, sign * z / (1 - bent * z) * value[face], count)
    return (out / rays**2).reshape(-1, h, w)


def occupancy(vertices: np.ndarray, faces: np.ndarray, values: np.ndarray, grid: Grid, rays: int) -> np.ndarray:
    """[C, Z, Y, X] float64 values averaged over voxels (rays along z; exact overlap of each depth interval)."""
    nz, ny, nx = grid.shape
    position = (vertices - np.array(grid.origin)) / np.array(grid.voxel_size)
    position[:, :2] = rays * (position[:, :2] + 0.5) - 0.5 + np.array(NUDGE)
    position[:, 2] += 0.5  # now voxel k spans [k, k + 1]
    # A surface at depth z fills every voxel below it: deposit its part at voxel k = ⌊z⌋, the rest at k - 1,
    # and sum downwards. Slot 0 collects what lies below the grid.
    out = np.zeros((len(values), (nz + 1) * ny * nx))
    for ray, z, sign, face in ray_hits(position, faces, (rays * ny, rays * nx)):
        depth = np.clip(z, 0, nz)
        k = np.minimum(depth.astype(np.int64), nz - 1)
        row, column = ray // (rays * nx), ray % (rays * nx)
        slot = k * ny * nx + (row // rays) * nx + column // rays
        for c, value in enumerate(values):
            weight = sign * value[face]
            out[c] += np.bincount(slot + ny * nx, weight * (depth - k), out.shape[1])
            out[c] += np.bincount(slot, weight * (1 - depth + k), out.shape[1])
    filled = out.reshape(-1, nz + 1, ny, nx)[:, ::-1].cumsum(axis=1)[:, ::-1]
    filled[np.abs(filled) < 1e-12 * np.abs(values).max()] = 0  # what the sums leave of a zero
    return filled[:, 1:] / rays**2


def ray_hits(
    points: np.ndarray, faces: np.ndarray, shape: tuple[int, int]
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
    """Batches of hits `(ray, z, sign, face)`: flat lattice index, depth, +1 where the ray leaves, -1 where it enters.

    points: [P, 3] as (column, row, depth), the first two in lattice units; shape: lattice (rows, columns).
    """
    corners = points[faces]
    first, last = _half_open(corners[..., 1].min(1), corners[..., 1].max(1), shape[0])
    columns = np.ceil(np.ptp(corners[..., 0], axis=1)) + 1
    batch = np.cumsum((last - first) * np.minimum(columns, shape[1])) // MAX_HITS
    for b in np.unique(batch[last > first]):
        face = np.flatnonzero((batch == b) & (last > first))
        yield _scan_convert(corners[face], face, first[face], last[face], shape)


def _scan_convert(
    corners: np.ndarray, face: np.ndarray, first: np.ndarray, last: np.ndarray, shape: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Hits of the triangles `corners` [F, 3, (column, row, depth)] on the rows [first, last)."""
    (a, b, c) = np.moveaxis(corners, 1, 0)
    ab, ac = b - a, c - a
    area = ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):  # edge-on faces are never hit
        slope_u = (ab[:, 2] * ac[:, 1] - ab[:, 1] * ac[:, 2]) / area
        slope_v = (ab[:, 0] * ac[:, 2] - ab[:, 2] * ac[:, 0]) / area
    upright = np.take_along_axis(corners, np.argsort(corners[..., 1], axis=1, kind="stable")[..., None], axis=1)

    t, row = _expand(first, last)  # one entry a (triangle, row)
    low, mid, high = (upright[t, i] for i in range(3))
    upper = (row >= mid[:, 1])[:, None]
    one = _crossing(low, high, row)
    other = _crossing(np.where(upper, mid, low), np.where(upper, high, mid), row)
    start, stop = _half_open(np.minimum(one, other), np.maximum(one, other), shape[1])

    r, column = _expand(start, stop)  # one entry a hit
    t, row = t[r], row[r]
    z = a[t, 2] + slope_u[t] * (column - a[t, 0]) + slope_v[t] * (row - a[t, 1])
    z = np.clip(z, corners[..., 2].min(1)[t], corners[..., 2].max(1)[t])
    return row * shape[1] + column, z, np.sign(area)[t], face[t]


def _crossing(low: np.ndarray, high: np.ndarray, row: np.ndarray) -> np.ndarray:
    """Column at which the edges low → high cross `row`."""
    return low[:, 0] + (row - low[:, 1]) * ((high[:, 0] - low[:, 0]) / (high[:, 1] - low[:, 1]))


def _half_open(low: np.ndarray, high: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """First and one-past-last lattice index in [low, high), clipped to [0, count)."""
    start = np.clip(np.ceil(low), 0, count).astype(np.int64)
    return start, np.maximum(np.clip(np.ceil(high), 0, count).astype(np.int64), start)


def _expand(start: np.ndarray, stop: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Every integer of every range [start, stop), with the index of its range."""
    counts = stop - start
    owner = np.repeat(np.arange(len(counts)), counts)
    offset = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)
    return owner, start[owner] + offset
