"""Scan conversion of triangles in float64, in plain torch on any device: which rays hit which face, and how deep.

Rays sit at integer coordinates of a lattice. Rows and spans are half-open and every edge is evaluated from its
lower to its upper end, so neighbouring faces compute the same crossing and each ray of a closed surface is
counted exactly once (no cracks, no doubles).
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

MAX_HITS = {"cpu": 1_000_000, "cuda": 16_000_000}
"""Hits held in memory at once, by the kind of device: some 0.1 and 2 GB. More do not fit a CPU's caches."""

NUDGE = (3.1e-8, 7.3e-8)
"""Lattice offset (columns, rows): keeps rays off vertices of axis-aligned bodies; far below any accuracy."""


def mean_depths(
    lab: Tensor, faces: Tensor, values: Tensor, shape: tuple[int, int], pitch: float, rays: int, bent: float = 0.0
) -> Tensor:
    """[C, H, W] float64: Σ over hits of `sign · z · value`, the mean over the `rays × rays` rays of each pixel.

    lab: [P, 3] vertices [m], over `1 + bent z`; values: [C, F]; shape: pixels (H, W) of `pitch` [m]; bent: one over the
    source's distance [1/m]; float64 and int64, on one device.
    """
    (h, w), fine = shape, (shape[0] * rays, shape[1] * rays)
    out = values.new_zeros(len(values), h * w)
    for ray, z, sign, face in ray_hits(on_lattice(lab, shape, pitch, rays), faces, fine):
        row, column = ray // fine[1], ray % fine[1]
        pixel = row // rays * w + column // rays  # at once: the raster of all rays would not fit the caches
        depth = sign * z / (1 - bent * z)
        first, last = (int(end) for end in pixel.aminmax()) if len(pixel) else (0, -1)
        for total, value in zip(out, values):
            total[first : last + 1] += torch.bincount(pixel - first, depth * value[face], last + 1 - first)
    return (out / rays**2).reshape(-1, h, w)


def on_lattice(lab: Tensor, shape: tuple[int, int], pitch: float, rays: int) -> Tensor:
    """Vertices [P, 3] m as (column, row) on the lattice of the rays and depth [m]; arguments as those of
    `mean_depths`."""
    u, v = (
        rays * lab[:, axis] / pitch + 0.5 * (rays * count - 1) + nudge
        for axis, count, nudge in zip((0, 1), shape[::-1], NUDGE)
    )
    return torch.stack([u, v, lab[:, 2]], 1)


def ray_hits(points: Tensor, faces: Tensor, shape: tuple[int, int]) -> Iterator[tuple[Tensor, Tensor, Tensor, Tensor]]:
    """Batches of hits `(ray, z, sign, face)`: flat lattice index, depth, +1 where the ray leaves, -1 where it enters.

    points: [P, 3] as (column, row, depth), the first two in lattice units; shape: lattice (rows, columns).
    """
    corners = points[faces]
    column, row = corners[..., 0], corners[..., 1]
    first, last = _half_open(row.amin(1), row.amax(1), shape[0])
    columns = (column.amax(1) - column.amin(1)).ceil() + 1
    batch = ((last - first) * columns.clamp_max(shape[1])).cumsum(0) // MAX_HITS[points.device.type]
    for b in batch[last > first].unique().tolist():
        face = ((batch == b) & (last > first)).nonzero()[:, 0]
        yield _scan_convert(corners[face], face, first[face], last[face], shape)


def _scan_convert(
    corners: Tensor, face: Tensor, first: Tensor, last: Tensor, shape: tuple[int, int]
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Hits of the triangles `corners` [F, 3, (column, row, depth)] on the rows [first, last)."""
    a, b, c = corners.unbind(1)
    ab, ac = b - a, c - a
    area = ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0]  # 0 of faces seen edge-on, which are never hit
    slope_u = (ab[:, 2] * ac[:, 1] - ab[:, 1] * ac[:, 2]) / area
    slope_v = (ab[:, 0] * ac[:, 2] - ab[:, 2] * ac[:, 0]) / area
    upright = corners.take_along_dim(corners[..., 1].argsort(dim=1, stable=True)[..., None], 1)

    t, row = _expand(first, last)  # one entry a (triangle, row)
    low, mid, high = upright[t].unbind(1)
    upper = (row >= mid[:, 1])[:, None]
    one = _crossing(low, high, row)
    other = _crossing(torch.where(upper, mid, low), torch.where(upper, high, mid), row)
    start, stop = _half_open(one.minimum(other), one.maximum(other), shape[1])

    r, column = _expand(start, stop)  # one entry a hit
    t, row = t[r], row[r]
    z = a[t, 2] + slope_u[t] * (column - a[t, 0]) + slope_v[t] * (row - a[t, 1])
    z = z.clamp(corners[..., 2].amin(1)[t], corners[..., 2].amax(1)[t])
    return row * shape[1] + column, z, area.sign()[t], face[t]


def _crossing(low: Tensor, high: Tensor, row: Tensor) -> Tensor:
    """Column at which the edges low → high cross `row`."""
    return low[:, 0] + (row - low[:, 1]) * ((high[:, 0] - low[:, 0]) / (high[:, 1] - low[:, 1]))


def _half_open(low: Tensor, high: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """First and one-past-last lattice index in [low, high), clipped to [0, count)."""
    start, stop = (edge.ceil().clamp(0, count).long() for edge in (low, high))
    return start, stop.maximum(start)


def _expand(start: Tensor, stop: Tensor) -> tuple[Tensor, Tensor]:
    """Every integer of every range [start, stop), with the index of its range."""
    counts = stop - start
    owner = torch.arange(len(counts), device=counts.device).repeat_interleave(counts)
    offset = torch.arange(len(owner), device=counts.device) - (counts.cumsum(0) - counts)[owner]
    return owner, start[owner] + offset
