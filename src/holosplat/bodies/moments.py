"""Moments of what closed meshes enclose."""

from __future__ import annotations

import numpy as np

from ..mesh import TriangleMesh


def moments(mesh: TriangleMesh) -> tuple[float, np.ndarray, np.ndarray]:
    """Volume [m³], centre [3] [m], and second moments about it [3, 3] [m⁵] of what a closed mesh encloses.

    Sums over tetrahedra from a point inside to the triangles, each exact: ∫ x xᵀ = V/20 (Σ pᵢ pᵢᵀ + s sᵀ), s = Σ pᵢ.
    """
    origin = mesh.vertices.mean(0)
    corners = (mesh.vertices - origin)[mesh.faces]
    a, b, c = np.moveaxis(corners, 1, 0)
    parts = np.einsum("fi,fi->f", a, np.cross(b, c)) / 6
    total, sums = corners.sum(1), parts.sum()
    middle = (parts[:, None] * total / 4).sum(0) / sums
    second = np.einsum("f,fci,fcj->ij", parts, corners, corners) + np.einsum("f,fi,fj->ij", parts, total, total)
    return float(sums), origin + middle, second / 20 - sums * np.outer(middle, middle)


def centroid(mesh: TriangleMesh) -> np.ndarray:
    """Centre of mass `(x, y, z)` [m] of what a closed mesh encloses."""
    origin = mesh.vertices.mean(0)
    a, b, c = np.moveaxis((mesh.vertices - origin)[mesh.faces], 1, 0)
    parts = np.einsum("fi,fi->f", a, np.cross(b, c)) / 6
    return origin + (parts[:, None] * (a + b + c) / 4).sum(0) / parts.sum()


def second_moments(mesh: TriangleMesh) -> np.ndarray:
    """[3, 3] of what a closed mesh encloses about its middle, over its volume, in the square of the unit of its
    vertices."""
    volume, _, second = moments(mesh)
    return second / volume


def stretched_like(mesh: TriangleMesh, rest: TriangleMesh) -> np.ndarray:
    """Matrix [3, 3] of determinant one by which the ellipsoid of second moments of `rest` becomes one like `mesh`'s."""
    (values, axes), (rests, frame) = (np.linalg.eigh(moments(one)[2]) for one in (mesh, rest))
    axes = axes * np.sign(np.linalg.det(axes) * np.linalg.det(frame)) ** np.array([1, 0, 0])
    stretch = np.sqrt(np.maximum(values, 0) / rests)
    return (axes * (stretch / stretch.prod() ** (1 / 3))) @ frame.T
