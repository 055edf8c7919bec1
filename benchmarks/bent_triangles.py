"""Triangles divided where the surface bends: what `triangles.py` compares with those that are divided all alike."""

from __future__ import annotations

import numpy as np


def divided(points: np.ndarray, triangles: np.ndarray, longer: float, beside: float) -> tuple[np.ndarray, np.ndarray]:
    """Points [P + N, 3] and triangles [G, 3] of the same closed surface, N edges divided, wound as before.

    longer, beside: an edge is divided that is longer, and has its middle farther beside the surface that the normals of
    its ends describe [the unit of points [P, 3]]; there the new point lies. So that triangles fit together and do not
    get thin, the longest edge of a triangle with a divided one is divided, too (Rivara 1984, "Algorithms for refining
    triangular grids suitable for adaptive and multigrid techniques"). Old points stay, and so does what is flat.
    """
    edges, sides = edges_of(triangles)
    lengths = np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1)
    away = sagittae(points, triangles, edges)
    marked = (lengths > longer) & (np.linalg.norm(away, axis=1) > beside)
    rank = np.argsort(np.lexsort((np.arange(len(edges)), lengths)))  # no two edges are equally long
    longest = rank[sides].argmax(1)
    base = np.take_along_axis(sides, longest[:, None], 1)[:, 0]
    while len(new := base[marked[sides].any(1) & ~marked[base]]):
        marked[new] = True
    middle = np.where(marked, len(points) + np.cumsum(marked) - 1, -1)
    turned = (longest[:, None] + np.arange(3)) % 3  # AB is the longest edge
    corners, middles = (np.take_along_axis(values, turned, 1) for values in (triangles, middle[sides]))
    added = points[edges[marked]].mean(1) + away[marked]
    return np.concatenate([points, added]), _pieces(corners, middles)


def edges_of(triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Edges [E, 2], each once, and the number of the edges AB, BC, CA of each triangle [F, 3]."""
    sides = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]], axis=2).reshape(-1, 2)
    edges, index = np.unique(sides, axis=0, return_inverse=True)
    return edges, index.reshape(-1, 3)


def sagittae(points: np.ndarray, triangles: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """From the middle of each edge to the surface [E, 3]: that of the cubic whose ends have the surface's tangents
    (Vlachos et al. 2001, "Curved PN triangles", section 3); on a sphere of radius R, h²/8R of an edge h."""
    normals = normals_of(points, triangles)
    along = points[edges[:, 1]] - points[edges[:, 0]]
    first, last = (n * (along * n).sum(1, keepdims=True) for n in (normals[edges[:, 0]], normals[edges[:, 1]]))
    return (last - first) / 8


def normals_of(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Outward normals of the points [P, 3]; exact on spheres, however uneven the triangles (Max 1999, "Weights for
    computing vertex normals from facet normals")."""
    corners, found = points[triangles], np.zeros_like(points)
    for k in range(3):
        one, other = (corners[:, (k + step) % 3] - corners[:, k] for step in (1, 2))
        normal = np.cross(one, other) / (np.square(one).sum(1) * np.square(other).sum(1))[:, None]
        for axis in range(3):
            found[:, axis] += np.bincount(triangles[:, k], normal[:, axis], len(points))
    return found / np.linalg.norm(found, axis=1, keepdims=True)


def _pieces(corners: np.ndarray, middles: np.ndarray) -> np.ndarray:
    """Triangles [G, 3] that those of `corners` [F, 3] fall into, whose edges AB, BC, CA have `middles` [F, 3] or -1.

    One with any has that of AB. Pieces lie where their triangle lay, so that neighbours stay near in memory.
    """
    (a, b, c), (ab, bc, ca) = corners.T, middles.T
    count, has = (middles >= 0).sum(1), bc >= 0
    ways = [
        (count == 0, [(a, b, c)]),
        (count == 1, [(a, ab, c), (ab, b, c)]),
        ((count == 2) & has, [(a, ab, c), (ab, b, bc), (ab, bc, c)]),
        ((count == 2) & ~has, [(ab, b, c), (a, ab, ca), (ab, c, ca)]),
        (count == 3, [(a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca)]),
    ]
    parts = [(np.flatnonzero(where), np.stack(piece, 1)[where]) for where, pieces in ways for piece in pieces]
    order = np.argsort(np.concatenate([part[0] for part in parts]), kind="stable")
    return np.concatenate([part[1] for part in parts])[order]
