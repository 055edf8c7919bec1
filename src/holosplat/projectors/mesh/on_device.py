"""Rays through meshes in plain torch, on any device: what `reference.py` does with numpy."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from .reference import NUDGE

MAX_HITS = 16_000_000
"""Hits held in memory at once: some 2 GB."""


def mean_depths(
    lab: Tensor, faces: Tensor, values: Tensor, shape: tuple[int, int], pitch: float, rays: int, bent: float = 0.0
) -> Tensor:
    """[C, H, W] float64: Σ over hits of `sign · z · value`, the mean over the `rays × rays` rays of each pixel.

    lab: [P, 3] vertices [m], over `1 + bent z`; values: [C, F]; shape: pixels (H, W) of `pitch` [m]; bent: one over the
    source's distance [1/m]; float64 and int64, on one device.
    """
    (h, w), fine = shape, (shape[0] * rays, shape[1] * rays)
    u = rays * lab[:, 0] / pitch + 0.5 * (fine[1] - 1) + NUDGE[0]
    v = rays * lab[:, 1] / pitch + 0.5 * (fine[0] - 1) + NUDGE[1]
    out = values.new_zeros(len(values), h * w)
    for ray, depth, face in ray_hits(torch.stack([u, v, lab[:, 2]], 1), faces, fine, bent):
        row, column = ray // fine[1], ray % fine[1]
        out.index_add_(1, row // rays * w + column // rays, depth * values[:, face])
    return (out / rays**2).reshape(-1, h, w)


def ray_hits(
    points: Tensor, faces: Tensor, shape: tuple[int, int], bent: float
) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """Batches of hits `(ray, depth, face)`: flat lattice index, and the depth, negative where the ray enters.

    points: [P, 3] as (column, row, depth), the first two in lattice units; shape: lattice (rows, columns).
    """
    corners = points[faces]
    column, row = corners[..., 0], corners[..., 1]
    first, last = _half_open(row.amin(1), row.amax(1), shape[0])
    columns = (column.amax(1) - column.amin(1)).ceil() + 1
    batch = ((last - first) * columns.clamp_max(shape[1])).cumsum(0) // MAX_HITS
    for b in batch[last > first].unique().tolist():
        face = ((batch == b) & (last > first)).nonzero()[:, 0]
        ray, depth, owner = _scan_convert(corners[face], first[face], last[face], shape, bent)
        yield ray, depth, face[owner]


def _scan_convert(
    corners: Tensor, first: Tensor, last: Tensor, shape: tuple[int, int], bent: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Hits of the triangles `corners` [F, 3, (column, row, depth)] on the rows [first, last), and whose they are."""
    a, b, c = corners.unbind(1)
    ab, ac = b - a, c - a
    area = ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0]
    slope_u = (
        ab[:, 2] * ac[:, 1] - ab[:, 1] * ac[:, 2]
    ) / area  # no number for faces seen edge-on, which are never hit
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
    depth = a[t, 2] + slope_u[t] * (column - a[t, 0]) + slope_v[t] * (row - a[t, 1])
    depth = depth.clamp(corners[..., 2].amin(1)[t], corners[..., 2].amax(1)[t])
    return row * shape[1] + column, area.sign()[t] * depth / (1 - bent * depth), t


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
