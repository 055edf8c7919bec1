"""Finer triangles for the same smooth surface."""

from __future__ import annotations

import numpy as np
import torch
from scipy.sparse import coo_array
from torch import Tensor


def edge_lengths(vertices: Tensor, faces: Tensor) -> Tensor:
    """Lengths [3 F] of the triangles' edges, in the unit of `vertices` [P, 3]; faces [F, 3]."""
    corners = vertices[faces]
    return (corners - corners.roll(1, dims=1)).norm(dim=2).flatten()


def subdivided(vertices: Tensor, faces: Tensor) -> tuple[Tensor, Tensor]:
    """Vertices [P + E, 3] and faces [4 F, 3]: each triangle of closed surfaces is four (C. Loop 1987, "Smooth
    subdivision surfaces based on triangles", section 3), wound as before.

    New vertices lie at 3/8 of both ends of their edge and 1/8 of both corners across it; old ones move to
    `(1 - nβ) v + β Σ neighbours`, `β = (5/8 - (3/8 + cos(2π/n)/4)²)/n`. So facets become a smooth surface; a sphere of
    triangles shrinks a little, which a fit gives back.
    """
    points, triangles = vertices.detach().double().numpy(), faces.numpy()
    edges, edge_of = _edges(triangles)
    count = len(points)
    ends = points[edges].sum(axis=1)
    across = _summed(edge_of.ravel(), points[triangles[:, [2, 0, 1]].ravel()], len(edges))
    middles = 0.375 * ends + 0.125 * across
    degree = np.bincount(edges.ravel(), minlength=count)
    neighbours = _summed(edges.ravel(), points[edges[:, ::-1].ravel()], count)
    n = np.maximum(degree, 3)
    beta = ((0.625 - (0.375 + 0.25 * np.cos(2 * np.pi / n)) ** 2) / n)[:, None]
    old = (1 - degree[:, None] * beta) * points + beta * neighbours
    ab, bc, ca = (edge_of[:, k] + count for k in range(3))
    a, b, c = triangles.T
    finer = np.stack([a, ab, ca, b, bc, ab, c, ca, bc, ab, bc, ca], axis=1).reshape(-1, 3)
    return torch.from_numpy(np.concatenate([old, middles])).to(vertices), torch.from_numpy(finer).to(faces)


def _edges(triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Edges [E, 2], each once, and the number of the edges AB, BC, CA of each triangle [F, 3]."""
    sides = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]], axis=2).reshape(-1, 2).astype(np.int64)
    keys, index = np.unique(sides[:, 0] * (int(triangles.max()) + 1) + sides[:, 1], return_inverse=True)
    first = int(triangles.max()) + 1
    return np.stack([keys // first, keys % first], axis=1), index.reshape(-1, 3)


def _summed(index: np.ndarray, values: np.ndarray, count: int) -> np.ndarray:
    """Sums [count, 3] of `values` [N, 3] by their `index` [N]."""
    select = coo_array((np.ones(len(index)), (index, np.arange(len(index)))), shape=(count, len(index)))
    return np.asarray(select.tocsr() @ values)
