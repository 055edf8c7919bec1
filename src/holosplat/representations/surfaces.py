"""Closed deformable surfaces of one material, as an Object."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ..checks import InputError, require
from ..geometry import Grid, Poses, Views
from ..mesh import TriangleMesh, shell_labels, winding_number
from ..projectors.surface import surface_occupancy, surface_thickness
from ..volume import LineIntegrals, Volume


class SurfaceMesh:
    """Closed triangle surfaces, filled with a material of `delta` and `beta`; the vertices are trainable.

    vertices: [P, 3] float64 `(x, y, z)` in units of `unit_length` [m], the scan's pixel size; faces: [F, 3] int64,
    counter-clockwise seen from the side without matter, so that an inner shell bounds a cavity. Bodies that overlap
    add up. lines: rows that are integrated in a pixel of a projection. Errors: `InputError` if the arrays do not fit.
    """

    def __init__(
        self, vertices: Tensor, faces: Tensor, unit_length: float, delta: float, beta: float, lines: int = 2
    ) -> None:
        shapes = [tuple(vertices.shape), tuple(faces.shape)]
        fits = all(len(shape) == 2 and shape[1] == 3 for shape in shapes) and shapes[1][0] > 0
        require(fits, f"a surface needs vertices (P, 3) and at least one face (F, 3), but got {shapes}.")
        self.vertices, self.faces, self.lines = vertices, faces, lines
        self.unit_length, self.delta, self.beta = float(unit_length), float(delta), float(beta)

    @property
    def stored_bytes(self) -> int:
        """Size of vertices as float32 and faces as int32."""
        return 4 * (self.vertices.numel() + self.faces.numel())

    def replaced(self, vertices: Tensor) -> SurfaceMesh:
        """The same surfaces with other vertices."""
        return SurfaceMesh(vertices, self.faces, self.unit_length, self.delta, self.beta, self.lines)

    def at(self, time: float) -> SurfaceMesh:
        """The surfaces themselves: they do not move."""
        return self

    def project(self, views: Views | Poses) -> LineIntegrals:
        """Line integrals (B, D), float64, differentiable in the vertices and in the rotations and shifts of `Poses`."""
        poses = Poses.of(views) if isinstance(views, Views) else views
        pitch = poses.pixel_size
        thickness = surface_thickness(
            self.vertices * (self.unit_length / pitch),
            self.faces,
            poses.rotations,
            poses.shifts / pitch,
            poses.shape,
            self.lines,
        )
        return LineIntegrals(thickness[:, None], ((self.delta * pitch, self.beta * pitch),))

    def voxelise(self, grid: Grid) -> Volume:
        """δ and β on `grid`, averaged over voxels."""
        voxel = torch.tensor(grid.voxel_size, dtype=torch.float64)
        offset = torch.tensor(grid.origin, dtype=torch.float64)
        vertices = (self.vertices.detach() * self.unit_length - offset) / voxel
        occupancy = surface_occupancy(vertices, self.faces, grid.shape).numpy()
        return Volume(occupancy * self.delta, occupancy * self.beta, grid)

    def mesh(self, name: str = "surfaces") -> TriangleMesh:
        """All surfaces as one mesh [m]."""
        return TriangleMesh(self.vertices.detach().numpy() * self.unit_length, self.faces.numpy(), name)

    def bodies(self) -> list[TriangleMesh]:
        """One mesh [m] for each body, with its cavities, the largest first, named body000, body001 …

        `InputError` if no surface encloses matter.
        """
        whole = self.mesh()
        labels = shell_labels(whole.faces, len(whole.vertices))
        shells = [_compact(whole, whole.faces[labels == k], "shell") for k in range(labels.max() + 1)]
        shells.sort(key=lambda shell: -shell.volume)
        outer = [shell for shell in shells if shell.volume > 0]
        if not outer:
            raise InputError("the surfaces enclose no matter: all of them bound cavities; check how they are wound.")
        members: list[list[TriangleMesh]] = [[shell] for shell in outer]
        for cavity in shells[len(outer) :]:
            around = [round(winding_number(o.vertices[o.faces], cavity.vertices[0]), 3) for o in outer]
            smallest = max(range(len(outer)), key=lambda k: (around[k], k))  # outer ones are sorted by size
            members[smallest].append(cavity)
        return [_joined(parts, f"body{k:03d}") for k, parts in enumerate(members)]


def _compact(mesh: TriangleMesh, faces: np.ndarray, name: str) -> TriangleMesh:
    """The part of `mesh` that `faces` need."""
    used, index = np.unique(faces, return_inverse=True)
    return TriangleMesh(mesh.vertices[used], index.reshape(-1, 3), name)


def _joined(parts: list[TriangleMesh], name: str) -> TriangleMesh:
    starts = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
    faces = [part.faces + start for part, start in zip(parts, starts)]
    return TriangleMesh(np.concatenate([part.vertices for part in parts]), np.concatenate(faces), name)
