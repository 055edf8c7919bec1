"""The unstressed membrane: its nodes, edges and triangles, their lengths, areas and angles, and their derivatives."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import torch
from torch import Tensor

from ...checks import InputError, require
from ...mesh import TriangleMesh


@dataclass(frozen=True, eq=False)
class RestShape:
    """A closed surface of P nodes, F triangles and E edges, and its measures at rest (float64 unless `to` changed it).

    faces: [F, 3].
    edges: [E, 2], nodes a and b of each.
    opposite: [E, 2], the third nodes c and d of the triangles (a, b, c) and (b, a, d) beside it.
    beside: [E, 2], the numbers of these triangles.
    length: [E] [m].
    angle: [E] between the triangles' normals, positive where the surface is convex [rad].
    area: [F] [m²].
    frame: [F, 2, 2], the inverse of each triangle's two sides (columns, in its own plane) [1/m].
    surface, volume: of the whole membrane [m², m³].
    """

    faces: Tensor
    edges: Tensor
    opposite: Tensor
    beside: Tensor
    length: Tensor
    angle: Tensor
    area: Tensor
    frame: Tensor
    surface: Tensor
    volume: Tensor

    @classmethod
    def of(cls, mesh: TriangleMesh) -> RestShape:
        """The rest shape `mesh`; `InputError` unless it is closed, wound outwards, and has no triangle without area."""
        require(mesh.volume > 0, f"{mesh.name} must be wound outwards, but its volume is not positive; repair it.")
        edges, opposite, beside = _hinges(mesh)
        faces = torch.from_numpy(mesh.faces.copy())
        nodes = torch.from_numpy(mesh.vertices.copy())
        corners = corners_of(nodes, faces)
        area = triangle_areas(corners)
        whole = bool((area > 1e-9 * area.mean()).all())
        require(whole, f"{mesh.name}: triangles of a membrane must have an area, but some have none; remesh it.")
        return cls(
            faces,
            edges,
            opposite,
            beside,
            edge_lengths(nodes, edges),
            dihedral_angles(nodes, edges, opposite),
            area,
            _frames(corners),
            area.sum(),
            enclosed_volume(corners),
        )

    def to(self, dtype: torch.dtype | None = None, device: torch.device | str | None = None) -> RestShape:
        """The same with its measures in `dtype`, on `device`."""
        found = {field.name: getattr(self, field.name) for field in fields(self)}
        floats = {name: dtype if t.is_floating_point() else None for name, t in found.items()}
        return RestShape(**{name: t.to(device, floats[name]) for name, t in found.items()})


def _hinges(mesh: TriangleMesh) -> tuple[Tensor, Tensor, Tensor]:
    """Edges, opposite nodes and triangles on either side, each [E, 2]."""
    start = mesh.faces.reshape(-1)
    end = np.roll(mesh.faces, -1, axis=1).reshape(-1)
    third = np.roll(mesh.faces, -2, axis=1).reshape(-1)
    triangle = np.repeat(np.arange(len(mesh.faces)), 3)
    count = len(mesh.vertices)
    forth, back = start * count + end, end * count + start
    unique = len(np.unique(forth)) == len(forth)
    if not (unique and np.array_equal(np.sort(forth), np.sort(back))):
        raise InputError(
            f"{mesh.name} must be a closed surface, wound the same way everywhere, each side shared by two triangles, "
            "but it is not; repair it first."
        )
    require(len(np.unique(start)) == count, f"{mesh.name} must have no loose nodes, but it has; merge or remove them.")
    order, reverse = np.argsort(forth), np.argsort(back)
    first, second = order[start[order] < end[order]], reverse[start[order] < end[order]]
    pairs = ((start[first], end[first]), (third[first], third[second]), (triangle[first], triangle[second]))
    edges, opposite, beside = (torch.from_numpy(np.stack(pair, axis=1)) for pair in pairs)
    return edges, opposite, beside


def _frames(corners: Tensor) -> Tensor:
    """[F, 2, 2]: the inverse of the sides (b - a, c - a) of triangles [F, 3, 3] in orthonormal axes of their planes."""
    a, b, c = corners.unbind(-2)
    along = (b - a) / (b - a).norm(dim=-1, keepdim=True)
    normal = cross(b - a, c - a)
    across = cross(normal / normal.norm(dim=-1, keepdim=True), along)
    axes = torch.stack([along, across], dim=-2)
    return torch.linalg.inv(axes @ torch.stack([b - a, c - a], dim=-1))


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
