"""How far surfaces are from each other: exact distances of points from triangles."""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

from ..mesh import TriangleMesh


def normal_distance(one: TriangleMesh, other: TriangleMesh) -> float:
    """Root-mean-square distance [m] of two closed surfaces: of each from the nearest points of the other, both ways.

    The mean over a surface is over its vertices, each with the area around it; motion along a surface costs nothing.
    """
    squares = [_mean_square(one, other), _mean_square(other, one)]
    return float(np.sqrt(np.mean(squares)))


def distances(points: np.ndarray, mesh: TriangleMesh) -> np.ndarray:
    """Distances [P] [m] of `points` [P, 3] [m] from the nearest points of the triangles of `mesh`."""
    corners = mesh.vertices[mesh.faces]
    middles = corners.mean(1)
    reach = np.linalg.norm(corners - middles[:, None], axis=-1).max()
    used = KDTree(mesh.vertices[np.unique(mesh.faces)])
    # the nearest triangle is no farther than the nearest vertex, its middle no farther than its reach beyond that
    near = KDTree(middles).query_ball_point(points, used.query(points)[0] + reach)
    counts = np.array([len(found) for found in near])
    which = np.concatenate([np.asarray(found, dtype=np.int64) for found in near])
    found = _to_triangles(np.repeat(points, counts, axis=0), corners[which])
    return np.minimum.reduceat(found, np.cumsum([0, *counts[:-1]]))


def _mean_square(of: TriangleMesh, to: TriangleMesh) -> float:
    a, b, c = np.moveaxis(of.vertices[of.faces], 1, 0)
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    weights = np.bincount(of.faces.ravel(), np.repeat(areas, 3), minlength=len(of.vertices))
    used = weights > 0
    return float(np.average(distances(of.vertices[used], to) ** 2, weights=weights[used]))


def _to_triangles(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Distances [N] of points [N, 3] from triangles [N, 3, 3], each from its own: of the plane inside, or a side."""
    a, b, c = np.moveaxis(corners, 1, 0)
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=1)
    unit = normal / np.maximum(length, np.finfo(float).tiny)[:, None]
    inside, sides = length > 0, []
    for p, q in ((a, b), (b, c), (c, a)):
        inside = inside & (np.einsum("ni,ni->n", np.cross(q - p, points - p), unit) >= 0)
        way = q - p
        square = np.maximum(np.einsum("ni,ni->n", way, way), np.finfo(float).tiny)
        part = np.clip(np.einsum("ni,ni->n", points - p, way) / square, 0, 1)
        sides.append(np.linalg.norm(points - p - part[:, None] * way, axis=1))
    plane = np.abs(np.einsum("ni,ni->n", points - a, unit))
    return np.where(inside, plane, np.minimum.reduce(sides))
