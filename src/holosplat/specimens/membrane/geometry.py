"""Lengths, areas, angles and volumes of triangle surfaces, as differentiable functions of their nodes.

Nodes are [..., P, 3] [m], leading dimensions any number of surfaces of one topology.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor


def cross(a: Tensor, b: Tensor) -> Tensor:
    """The vector product of [..., 3] (several times faster on CPU than torch's own)."""
    x, y, z = a.unbind(-1)
    u, v, w = b.unbind(-1)
    return torch.stack([y * w - z * v, z * u - x * w, x * v - y * u], dim=-1)


def corners_of(nodes: Tensor, faces: Tensor) -> Tensor:
    """Corners [..., F, 3, 3] of triangles [F, 3]: triangle, corner, coordinate."""
    return nodes[..., faces, :]


def edge_lengths(nodes: Tensor, edges: Tensor) -> Tensor:
    """Lengths [..., E] [m] of edges [E, 2]."""
    return (nodes[..., edges[:, 1], :] - nodes[..., edges[:, 0], :]).norm(dim=-1)


def area_vectors(corners: Tensor) -> Tensor:
    """(b - a) × (c - a) [..., F, 3] [m²]: outward normals, twice the area long."""
    a, b, c = corners.unbind(-2)
    return cross(b - a, c - a)


def triangle_areas(corners: Tensor) -> Tensor:
    """Areas [..., F] [m²]."""
    return 0.5 * area_vectors(corners).norm(dim=-1)


def enclosed_volume(corners: Tensor) -> Tensor:
    """Signed volume [...] [m³] inside a closed surface: Σ a·(b × c)/6, about its own middle."""
    a, b, c = (corners - corners.mean(dim=(-3, -2), keepdim=True)).unbind(-2)
    return (a * cross(b, c)).sum(dim=(-2, -1)) / 6


def dihedral_angles(nodes: Tensor, edges: Tensor, opposite: Tensor) -> Tensor:
    """Angles [..., E] [rad] between the normals of the triangles (a, b, c) and (b, a, d), positive where convex."""
    a, b = nodes[..., edges[:, 0], :], nodes[..., edges[:, 1], :]
    c, d = nodes[..., opposite[:, 0], :], nodes[..., opposite[:, 1], :]
    first, second = cross(b - a, c - a), cross(d - a, b - a)
    return angle_between(b - a, first, second)


def angle_between(edge: Tensor, first: Tensor, second: Tensor) -> Tensor:
    """Angle [...] [rad] from the normal `first` to `second` [..., 3] about their common edge [..., 3]."""
    sine = (cross(first, second) * edge).sum(-1) / edge.norm(dim=-1)
    return torch.atan2(sine, (first * second).sum(-1))


def gyration_axes(nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Root-mean-square extents [..., 3] [m] along the principal axes, rising, and these axes [..., 3, 3] (columns)."""
    local = nodes - nodes.mean(axis=-2, keepdims=True)
    values, axes = np.linalg.eigh(np.einsum("...pi,...pj->...ij", local, local) / nodes.shape[-2])
    return np.sqrt(np.maximum(values, 0)), axes


def elongation(nodes: np.ndarray) -> np.ndarray:
    """(longest - middle)/(longest + middle) [...] of the extents: 0 for a cell at rest, towards 1 for a thread."""
    extents, _ = gyration_axes(nodes)
    return (extents[..., 2] - extents[..., 1]) / (extents[..., 2] + extents[..., 1])


def shape_change(nodes: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Root-mean-square distance [...] [m] of nodes from a `reference` [..., P, 3], moved and turned to fit best.

    The rotation is Kabsch's (1976, Acta Cryst. A 32, 922).
    """
    first = nodes - nodes.mean(axis=-2, keepdims=True)
    second = np.broadcast_to(reference - reference.mean(axis=-2, keepdims=True), first.shape)
    left, values, right = np.linalg.svd(np.einsum("...pi,...pj->...ij", first, second))
    values[..., 2] *= np.sign(np.linalg.det(left) * np.linalg.det(right))
    squares = (first**2).sum((-2, -1)) + (second**2).sum((-2, -1)) - 2 * values.sum(-1)
    return np.sqrt(np.maximum(squares, 0) / nodes.shape[-2])
