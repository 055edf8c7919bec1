"""Thickness and occupancy of closed surfaces in plain torch, float64, on any device: the specification of the twins.

A line of constant row cuts a triangle in a segment whose depth is linear in the column, and the pixels' edges cut that
into pieces. The thickness along the line is the sum of depths, positive where the beam leaves, negative where it
enters. Both triangles of an edge compute its crossing from the lower to the upper end, so segments meet exactly.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

QUADRATURE = ((2 / 3, 1 / 6, 1 / 6), (1 / 6, 2 / 3, 1 / 6), (1 / 6, 1 / 6, 2 / 3))
"""Barycentric points of equal weight, exact to second degree (Strang & Fix 1973, p. 184)."""


def thickness(points: Tensor, faces: Tensor, shape: tuple[int, int], lines: int) -> Tensor:
    """[V, H, W] float64 of points [V, P, 3] `(column, row, depth)`; arguments as the package's function, checked."""
    h, w = shape
    images = []
    for view in points:
        pixel, width, depth = pieces(view, faces, shape, lines)
        images.append(view.new_zeros(h * w).index_add_(0, pixel, width * depth).reshape(h, w))
    return torch.stack(images) if images else points.new_zeros(0, h, w)


def corner_shares(points: Tensor, faces: Tensor, gradient: Tensor, weights: Tensor) -> Tensor:
    """What each corner of each face gets of the image's gradient [V, H, W], views weighed by `weights` [V]: [F, 3]."""
    found = torch.einsum("v,vfq->fq", weights, sampled(points, faces, gradient))
    return found @ points.new_tensor(QUADRATURE)


def pose_gradients(points: Tensor, vertices: Tensor, faces: Tensor, gradient: Tensor) -> tuple[Tensor, Tensor]:
    """Gradients of rotations [V, 3, 3] and shifts [V, 2], of the image's [V, H, W]; float64, lengths in pixels.

    points: [V, P, 3] as above; vertices: [P, 3], the same in the object frame.
    """
    shares = sampled(points, faces, gradient) @ points.new_tensor(QUADRATURE)
    a, b, c = points[:, faces].unbind(2)
    normals = torch.linalg.cross(b - a, c - a) / 6  # vector area, shared by the three points
    pull = torch.einsum("vfc,vfx->vfcx", shares, normals)  # on each corner, in the lab frame
    return torch.einsum("vfcx,fcy->vxy", pull, vertices[faces]), -pull.sum((1, 2))[:, :2]


def sampled(points: Tensor, faces: Tensor, gradient: Tensor) -> Tensor:
    """The image's gradient [V, H, W] at the points of `QUADRATURE` on each face: [V, F, 3].

    It is linear between pixels, and falls to zero over a pixel beyond them. A single row or column stands for all.
    """
    h, w = gradient.shape[1:]
    corners = points[:, faces.reshape(-1), :2].reshape(len(points), *faces.shape, 2)
    samples = torch.einsum("qc,vfcx->vfqx", points.new_tensor(QUADRATURE), corners)
    # grid_sample has its first and last pixel at -1 and 1; a single row or column has no such scale.
    samples = samples * (2 / torch.tensor([max(w - 1, 1), max(h - 1, 1)]).to(points)) - 1
    return grid_sample(gradient[:, None], samples, padding_mode="zeros", align_corners=True)[:, 0]


def occupancy(vertices: Tensor, faces: Tensor, shape: tuple[int, int, int], lines: int) -> Tensor:
    """[Z, Y, X] float64: the part of each voxel that is enclosed; arguments as the package's function, checked."""
    nz, ny, nx = shape
    fine = vertices.detach() * torch.tensor([lines, 1, 1]).to(vertices)  # pieces as wide as lines are apart
    fine[:, 0] += 0.5 * (lines - 1)
    pixel, width, depth = pieces(fine, faces, (ny, nx * lines), lines)
    column = (pixel // (nx * lines)) * nx + pixel % (nx * lines) // lines
    # What is left behind a surface at `depth` empties the voxels beyond it: a part of one, and all that follow.
    depth = (depth + 0.5).clamp(0, nz)
    first = depth.long().clamp(max=nz - 1)
    part = depth - first
    out = vertices.new_zeros((nz + 1) * ny * nx)
    out.index_add_(0, first * (ny * nx) + column, width * (1 - part) / lines)
    out.index_add_(0, (first + 1) * (ny * nx) + column, width * part / lines)
    return -out.reshape(nz + 1, ny, nx)[:-1].cumsum(0)


def pieces(points: Tensor, faces: Tensor, shape: tuple[int, int], lines: int) -> tuple[Tensor, Tensor, Tensor]:
    """Pieces of segments: flat pixel, signed width in pixels over `lines`, depth at the middle; each [K].

    points: [P, 3] `(column, row, depth)` in pixels.
    """
    h, w = shape
    a, b, c = points[faces].unbind(1)
    area = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    upright = torch.stack((a, b, c), 1)
    upright = upright.take_along_dim(upright[..., 1].argsort(dim=1, stable=True)[..., None], 1)
    low, high = (((upright[:, i, 1] + 0.5) * lines - 0.5).ceil().clamp(0, h * lines).long() for i in (0, 2))
    owner, line = _every((low - 1).clamp(min=0), torch.where(area == 0, low - 1, high + 1).clamp(0, h * lines))
    row = (line.to(points) + 0.5) / lines - 0.5
    bottom, middle, top = upright[owner].unbind(1)
    hit = (row >= bottom[:, 1]) & (row < top[:, 1])  # the ranges may be off by their rounding
    owner, line, row, bottom, middle, top = (x[hit] for x in (owner, line, row, bottom, middle, top))
    below = (row < middle[:, 1])[:, None]
    one = _crossing(bottom, top, row)
    other = _crossing(torch.where(below, bottom, middle), torch.where(below, middle, top), row)
    return _cut(one, other, area[owner].sign() / lines, line // lines * w, w)


def _crossing(low: Tensor, high: Tensor, row: Tensor) -> Tensor:
    """(column, depth) [K, 2] at which edges from `low` up to `high` [K, 3] meet the lines `row` [K]."""
    share = (row - low[:, 1]) / (high[:, 1] - low[:, 1])
    return low[:, ::2] + share[:, None] * (high - low)[:, ::2]


def _cut(one: Tensor, other: Tensor, weight: Tensor, start: Tensor, width: int) -> tuple[Tensor, Tensor, Tensor]:
    """Segments between (column, depth) [K, 2], cut at the edges of pixels; `start` [K]: of their row of pixels."""
    turned = (one[:, 0] > other[:, 0])[:, None]
    a, b = torch.where(turned, other, one), torch.where(turned, one, other)
    left, right = a[:, 0].clamp(min=-0.5), b[:, 0].clamp(max=width - 0.5)
    first = (left + 0.5).floor().long().clamp(0, width)
    last = torch.where(right > left, (right + 0.5).ceil().long().clamp(0, width), first)
    owner, column = _every(first, last)
    left, right = left[owner].maximum(column - 0.5), right[owner].minimum(column + 0.5)
    a, b = a[owner], b[owner]
    slope = (b[:, 1] - a[:, 1]) / (b[:, 0] - a[:, 0])
    depth = a[:, 1] + slope * (0.5 * (left + right) - a[:, 0])
    return start[owner] + column, weight[owner] * (right - left), depth


def _every(start: Tensor, stop: Tensor) -> tuple[Tensor, Tensor]:
    """The index of each range [start, stop), repeated, and every integer in it."""
    counts = (stop - start).clamp(min=0)
    owner = torch.arange(len(counts), device=counts.device).repeat_interleave(counts)
    return owner, torch.arange(len(owner), device=counts.device) - (counts.cumsum(0) - counts)[owner] + start[owner]
