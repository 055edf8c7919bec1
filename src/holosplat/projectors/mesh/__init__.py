"""Exact line integrals through closed triangle meshes, and their partial occupancy of voxels.

The reference for every other projector: signed depths, no approximation but the sampling by rays.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ...backends import device, implementation
from ...checks import require, shaped
from ...geometry import Grid, Views
from .. import obliquity
from .filling import occupancy

__all__ = ["mesh_line_integrals", "voxelise_meshes"]


def mesh_line_integrals(
    vertices: np.ndarray, faces: np.ndarray, face_values: np.ndarray, views: Views, rays: int = 2, backend: str = "cpu"
) -> Tensor:
    """Line integrals [V, C, H, W] in metres × value, float64, of closed meshes with piecewise constant values.

    vertices: [P, 3] object frame [m]; faces: [F, 3] outward-oriented; face_values: [C, F], the value (δ, β, 1 …)
    inside the closed surface that each face belongs to. A pixel is the mean over `rays × rays` rays through it.
    Overlapping bodies add up. Along a ray the depth inside a closed surface is `Σ sign(n·z) z_hit` over the faces it
    crosses. In cones points go to `(x, y, z) / (1 + z / R)`, which keeps planes planes and makes rays parallel, and
    depths come back at the hits. backend: resolved.
    """
    _check(vertices, faces, face_values, rays)
    where, compute = device(backend), implementation(__name__, backend)
    corners, values = _on(where, faces, face_values)
    out = values.new_empty(len(views), len(values), *views.shape)
    for v, pixel in enumerate(views.pixel_sizes.tolist()):
        bent = 0.0 if views.sources is None else 1 / float(views.sources[v])
        lab = vertices @ views.rotations[v].T
        lab /= 1 + bent * lab[:, 2:]
        lab[:, :2] -= views.shifts[v]
        out[v] = compute.mean_depths(torch.from_numpy(lab).to(where), corners, values, views.shape, pixel, rays, bent)
        if bent:
            out[v] *= _obliquity(views, v).to(where)
    return out


def _obliquity(views: Views, v: int) -> Tensor:
    assert views.sources is not None
    return obliquity(views.shape, *(torch.as_tensor(a[v]) for a in (views.pixel_sizes, views.shifts, views.sources)))


def voxelise_meshes(
    vertices: np.ndarray, faces: np.ndarray, face_values: np.ndarray, grid: Grid, rays: int = 4
) -> np.ndarray:
    """Values [C, Z, Y, X] float64 of closed meshes, averaged over voxels: exact along z, `rays × rays` across."""
    _check(vertices, faces, face_values, rays)
    return occupancy(torch.tensor(vertices), *_on(torch.device("cpu"), faces, face_values), grid, rays).numpy()


def _on(where: torch.device, faces: np.ndarray, values: np.ndarray) -> tuple[Tensor, Tensor]:
    """Copies of faces and of their values, int64 and float64."""
    return (
        torch.tensor(faces, dtype=torch.int64, device=where),
        torch.tensor(values, dtype=torch.float64, device=where),
    )


def _check(vertices: np.ndarray, faces: np.ndarray, face_values: np.ndarray, rays: int) -> None:
    shaped("vertices", vertices, (None, 3))
    shaped("faces", faces, (None, 3))
    shaped("face_values", face_values, (None, len(faces)))
    for corner in (faces.min(), faces.max()) if len(faces) else ():
        require(
            0 <= corner < len(vertices),
            f"faces must name vertices 0 to {len(vertices) - 1}, but one names {corner}; correct the mesh.",
        )
    require(rays >= 1, f"rays must be at least 1, but it is {rays}.")
