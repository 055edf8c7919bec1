"""Closed deformable surfaces of one material, as an Object."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from ..backends import device
from ..checks import InputError, positive, require
from ..display import of_object
from ..geometry import Grid, Poses, Views
from ..matter import Matter
from ..mesh import TriangleMesh, shell_labels, winding_number
from ..projectors.surface import surface_occupancy, surface_thickness
from ..volume import LineIntegrals, Volume


class SurfaceMesh:
    """Closed triangle surfaces, filled with one material; the vertices are trainable.

    vertices: [P, 3] float64 `(x, y, z)` in units of `unit_length` [m], the scan's pixel size; faces: [F, 3] int64,
    counter-clockwise seen from the side without matter, so that an inner shell bounds a cavity. Bodies that overlap
    add up. matter: the one material inside. lines: rows that are integrated in a pixel of a projection. Errors:
    `InputError` if the arrays do not fit, or for more than one material.
    """

    kind: ClassVar[str] = "surfaces"
    """The name of this kind of Object in files."""
    _repr_html_ = of_object

    def __init__(self, vertices: Tensor, faces: Tensor, unit_length: float, matter: Matter, lines: int = 2) -> None:
        shapes = [tuple(vertices.shape), tuple(faces.shape)]
        fits = all(len(shape) == 2 and shape[1] == 3 for shape in shapes) and shapes[1][0] > 0
        require(fits, f"a surface needs vertices (P, 3) and at least one face (F, 3), but got {shapes}.")
        require(matter.single, "surfaces are filled with one material, but two channels of matter are given.")
        self.vertices, self.faces, self.lines = vertices, faces, lines
        self.unit_length, self.matter, self.backend = float(unit_length), matter, "cpu"

    def parameters(self) -> dict[str, Tensor]:
        """The trainable tensor, by name."""
        return {"vertices": self.vertices}

    def with_parameters(self, parameters: Mapping[str, Tensor]) -> SurfaceMesh:
        """The same triangles with other vertices."""
        vertices = parameters.get("vertices", self.vertices)
        return self._with(vertices, self.faces, self.backend)

    def _with(self, vertices: Tensor, faces: Tensor, backend: str) -> SurfaceMesh:
        surfaces = SurfaceMesh(vertices, faces, self.unit_length, self.matter, self.lines)
        surfaces.backend = backend
        return surfaces

    def state(self) -> dict[str, Any]:
        """Tensors and plain values that `from_state` makes the same surfaces of."""
        arrays = {"vertices": self.vertices, "faces": self.faces}
        return {**arrays, "unit_length": self.unit_length, "lines": self.lines, "matter": self.matter.as_dict()}

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> SurfaceMesh:
        """The surfaces that `state` described; `InputError` where it does not fit together."""
        matter = Matter.from_dict(state["matter"])
        faces, unit = state["faces"].long(), positive("unit_length", state["unit_length"], "metres")
        found = cls(state["vertices"], faces, unit, matter, int(state["lines"]))
        last = len(found.vertices) - 1
        require(
            0 <= int(faces.min()) <= int(faces.max()) <= last,
            f"faces must name vertices from 0 to {last}, but they name {int(faces.min())} to {int(faces.max())}.",
        )
        return found

    @property
    def described(self) -> str:
        """How large the surfaces are, in words."""
        return f"surfaces of {len(self.faces)} triangles"

    def on(self, backend: str) -> SurfaceMesh:
        """The surfaces for another backend (resolved: `cpu`, `cuda`, `reference`), on that backend's device."""
        there = device(backend)
        return self._with(self.vertices.to(there), self.faces.to(there), backend)

    @property
    def stored_bytes(self) -> int:
        """Size of vertices as float32 and faces as int32."""
        return 4 * (self.vertices.numel() + self.faces.numel())

    def enclosing_grid(self, most_voxels: int) -> Grid:
        """A grid around all vertices, of `unit_length` a voxel, or coarser where those would be over `most_voxels`."""
        return Grid.around(self.vertices.detach().cpu().numpy(), self.unit_length, most_voxels)

    def at(self, time: float) -> SurfaceMesh:
        """The surfaces themselves: they do not move."""
        return self

    def project(self, views: Views | Poses) -> LineIntegrals:
        """Line integrals (B, D), float64, differentiable in the vertices and in the numbers of `Poses`.

        Values are checked, but on a GPU, with Poses, which does not wait.
        """
        poses = Poses.of(views, self.vertices.device) if isinstance(views, Views) else views
        pitch = poses.pitch
        thickness = surface_thickness(
            self.vertices * (self.unit_length / pitch),
            self.faces,
            poses.rotations,
            poses.shifts / pitch,
            poses.shape,
            self.lines,
            self.backend,
            pixels=poses.scales,
            trusted=self.backend == "cuda" and not isinstance(views, Views),
        )
        return LineIntegrals(thickness[:, None], self.matter.in_lengths(pitch))

    def voxelise(self, grid: Grid) -> Volume:
        """δ and β on `grid`, averaged over voxels."""
        voxel, offset = (self.vertices.new_tensor(a, dtype=torch.float64) for a in (grid.voxel_size, grid.origin))
        vertices = (self.vertices.detach() * self.unit_length - offset) / voxel
        occupancy = surface_occupancy(vertices, self.faces, grid.shape).cpu().numpy()
        return self.matter.volume(occupancy[None], grid)

    def mesh(self, name: str = "surfaces") -> TriangleMesh:
        """All surfaces as one mesh [m]."""
        vertices = self.vertices.detach().cpu().numpy() * self.unit_length
        return TriangleMesh(vertices, self.faces.cpu().numpy(), name)

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
