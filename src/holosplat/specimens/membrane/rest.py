"""The unstressed membrane: its nodes, edges and triangles, their lengths, areas and angles, and their derivatives; and
resting red cells of even triangles, of 10 f² + 2 nodes (162, 252, 362, 492, 642, …). The image of an icosphere on the
shape of Evans & Fung has triangles squeezed at the rim, where springs would be stiffer one way than the other. Here the
nodes slide on the smooth surface until the edges are as even as they can be."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from ...checks import InputError, in_range, require
from ...mesh import TriangleMesh
from ..red_cells import DIAMETER, RedCell, half_thickness, icosphere


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


FREQUENCIES = (3, 20)
"""Least and greatest f: 92 to 4002 nodes."""
ITERATIONS = 300


def resting_cell(frequency: int = 6, diameter: float = DIAMETER) -> TriangleMesh:
    """A red cell at rest (Evans & Fung 1972), its axis along z: a closed mesh of 10 f² + 2 nodes, 20 f² even triangles.

    diameter [m] scales the whole cell. The nodes lie on the smooth surface. `InputError` for f outside 3 … 20.
    """
    nodes_of(frequency)
    in_range("cell diameter", diameter, 1e-9, 1.0, unit="metres")
    sphere, faces = _even_sphere(int(frequency))
    return TriangleMesh(RedCell(diameter).surface(sphere), faces, f"red cell of {len(sphere)} nodes")


def nodes_of(frequency: int) -> int:
    """How many nodes the mesh of a cell has; `InputError` for f outside 3 … 20."""
    low, high = FREQUENCIES
    whole = isinstance(frequency, (int, np.integer)) and low <= frequency <= high
    require(whole, f"frequency must be a whole number from {low} to {high}, but it is {frequency!r}.")
    return 10 * int(frequency) ** 2 + 2


def geodesic_sphere(frequency: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [10 f² + 2, 3] on the unit sphere and faces [20 f², 3], wound outwards: each side of the icosahedron
    cut into `frequency` parts."""
    vertices, faces = icosphere(0)
    rows = [(i, j) for i in range(frequency + 1) for j in range(frequency + 1 - i)]
    number = {row: n for n, row in enumerate(rows)}
    up = [(number[i, j], number[i + 1, j], number[i, j + 1]) for i, j in rows if i + j < frequency]
    down = [(number[i + 1, j], number[i + 1, j + 1], number[i, j + 1]) for i, j in rows if i + j < frequency - 1]
    weights = np.array([(frequency - i - j, i, j) for i, j in rows]) / frequency
    points = np.einsum("wk,fki->fwi", weights, vertices[faces]).reshape(-1, 3)
    triangles = np.array(up + down)[None] + len(rows) * np.arange(len(faces))[:, None, None]
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    mesh = TriangleMesh(points, triangles.reshape(-1, 3)).merged(1e-6)
    return mesh.vertices, mesh.faces


@lru_cache(maxsize=8)
def _even_sphere(frequency: int) -> tuple[np.ndarray, np.ndarray]:
    """Points [P, 3] of the unit sphere whose images on the resting cell are evenly spaced, and faces [F, 3].

    Minimises Σ (L²/L̄² - 1)² + Σ (A/Ā - 1)² over edges L and triangles A on the cell, by L-BFGS.
    """
    from scipy.optimize import minimize  # which takes long to load

    sphere, faces = geodesic_sphere(frequency)
    shape = RestShape.of(TriangleMesh(sphere, faces))

    def unevenness(flat: np.ndarray) -> tuple[float, np.ndarray]:
        points = torch.from_numpy(flat.reshape(-1, 3).copy()).requires_grad_()
        on_sphere = points / points.norm(dim=-1, keepdim=True)
        x, y, z = on_sphere.unbind(-1)
        nodes = torch.stack([x, y, z * half_thickness(x**2 + y**2)], dim=-1)
        square = edge_lengths(nodes, shape.edges) ** 2
        areas = triangle_areas(corners_of(nodes, shape.faces))
        value = ((square / square.mean() - 1) ** 2).sum() + ((areas / areas.mean() - 1) ** 2).sum()
        (gradient,) = torch.autograd.grad(value, points)
        return float(value.detach()), gradient.reshape(-1).numpy()

    found = minimize(unevenness, sphere.reshape(-1), jac=True, method="L-BFGS-B", options={"maxiter": ITERATIONS})
    points = found.x.reshape(-1, 3)
    points = points / np.linalg.norm(points, axis=1, keepdims=True)
    points.flags.writeable = False
    return points, faces
