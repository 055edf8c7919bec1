"""Resting red cells with even triangles, at any resolution: 10 f² + 2 nodes (162, 252, 362, 492, 642, …).

The image of an icosphere on the shape of Evans & Fung has triangles squeezed at the rim, where springs would be stiffer
one way than the other. Here the nodes slide on the smooth surface until the edges are as even as they can be.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import torch

from ...checks import in_range, require
from ...mesh import TriangleMesh
from ..red_cells import DIAMETER, RedCell, half_thickness, icosphere
from .rest import RestShape, corners_of, edge_lengths, triangle_areas

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
        nodes = _on_cell(on_sphere)
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


def _on_cell(sphere: torch.Tensor) -> torch.Tensor:
    """As `RedCell().surface`, in radii, for tensors."""
    x, y, z = sphere.unbind(-1)
    return torch.stack([x, y, z * half_thickness(x**2 + y**2)], dim=-1)
