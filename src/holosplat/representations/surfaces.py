"""Closed deformable surfaces, one inside another where there are several materials, as an Object; and those that move
and deform on smooth paths."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from ..backends import device, in_main_memory
from ..checks import InputError, positive, require
from ..display import of_object
from ..geometry import Grid, Poses, Views
from ..matter import DeltaBeta, Matter
from ..mesh import TriangleMesh, joined, part_of, shell_labels, winding_number
from ..projectors.surface import surface_occupancy, surface_thickness
from ..units import number_of
from ..volume import LineIntegrals, Unmoved, Volume
from .flow import TimeBasis, path_positions


class SurfaceMesh(Unmoved):
    """Closed triangle surfaces, filled with one material or several; the vertices are trainable.

    vertices: [P, 3] float64 `(x, y, z)` in units of `unit_length` [m], the scan's pixel size; faces: [F, 3] int64,
    counter-clockwise seen from the side without matter, so that an inner shell bounds a cavity. Bodies that overlap
    add up. matter: what is inside: shares of materials, that of the strongest contrast first. parts: how many faces
    belong to each of them (default: all to the one material), in their order. Those of a material enclose it and all
    stronger ones on its side of the medium, so that each closed surface is a step from one material to the next. lines:
    rows that are integrated in a pixel of a projection. Errors: `InputError` if the arrays do not fit, or for free δ
    and β.
    """

    kind: ClassVar[str] = "surfaces"
    """The name of this kind of Object in files."""
    _repr_html_ = of_object

    def __init__(
        self,
        vertices: Tensor,
        faces: Tensor,
        unit_length: float,
        matter: Matter,
        lines: int = 2,
        parts: Sequence[int] = (),
    ) -> None:
        shapes = [tuple(vertices.shape), tuple(faces.shape)]
        fits = all(len(shape) == 2 and shape[1] == 3 for shape in shapes) and shapes[1][0] > 0
        require(fits, f"a surface needs vertices (P, 3) and at least one face (F, 3), but got {shapes}.")
        require(matter.occupancies, "surfaces are filled with materials, but δ and β of the matter are free.")
        self.parts = tuple(int(count) for count in parts) or (len(faces),)
        require(
            len(self.parts) == len(matter) and min(self.parts) >= 0 and sum(self.parts) == len(faces),
            f"parts must say how many of {len(faces)} faces belong to each of {len(matter)} materials, but it is "
            f"{list(self.parts)}.",
        )
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
        surfaces = SurfaceMesh(vertices, faces, self.unit_length, self.matter, self.lines, self.parts)
        surfaces.backend = backend
        return surfaces

    @property
    def steps(self) -> list[Tensor]:
        """The faces [F, 3] of each material."""
        return list(self.faces.split(self.parts))

    def state(self) -> dict[str, Any]:
        """Tensors and plain values that `from_state` makes the same surfaces of."""
        arrays = {"vertices": self.vertices, "faces": self.faces}
        several = {"parts": list(self.parts)} if len(self.parts) > 1 else {}
        plain = {"unit_length": self.unit_length, "lines": self.lines, "matter": self.matter.as_dict()}
        return {**arrays, **plain, **several}

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> SurfaceMesh:
        """The surfaces that `state` described; `InputError` where it does not fit together."""
        matter = Matter.from_dict(state["matter"])
        faces, unit = state["faces"].long(), positive("unit_length", state["unit_length"], "metres")
        found = cls(state["vertices"], faces, unit, matter, int(state["lines"]), state.get("parts", ()))
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

    def enclosing_grid(self, most_voxels: int) -> Grid:
        """A grid around all vertices, of `unit_length` a voxel, or coarser where those would be over `most_voxels`."""
        return Grid.around(self.vertices.detach().cpu().numpy(), self.unit_length, most_voxels)

    def project(self, views: Views | Poses) -> LineIntegrals:
        """Line integrals (B, D), float64, differentiable in the vertices and in the numbers of `Poses`.

        Values are checked, but on a GPU, with Poses, which does not wait.
        """
        poses = Poses.of(views, self.vertices.device) if isinstance(views, Views) else views
        pitch = poses.pitch
        vertices = self.vertices * (self.unit_length / pitch)
        placed = (poses.rotations, poses.shifts / pitch, poses.shape, self.lines, self.backend)
        trusted = self.backend == "cuda" and not isinstance(views, Views)
        sources = None if poses.sources is None else poses.sources / pitch
        edges = {"pixels": poses.scales, "sources": sources}
        enclosed = [surface_thickness(vertices, faces, *placed, **edges, trusted=trusted) for faces in self.steps]
        return LineIntegrals(self._shares(enclosed, dim=1), self.matter.in_lengths(pitch))

    def voxelise(self, grid: Grid) -> Volume:
        """δ and β on `grid`, averaged over voxels."""
        return self.matter.volume(self.shares(grid).cpu().numpy(), grid)

    def shares(self, grid: Grid) -> Tensor:
        """The share [C, Z, Y, X] of each voxel of `grid` that each material fills, float64."""
        voxel, offset = (self.vertices.new_tensor(a, dtype=torch.float64) for a in (grid.voxel_size, grid.origin))
        vertices = (self.vertices.detach() * self.unit_length - offset) / voxel
        enclosed = [surface_occupancy(vertices, faces, grid.shape) for faces in self.steps]
        return self._shares(enclosed, dim=0)

    def _shares(self, enclosed: list[Tensor], dim: int) -> Tensor:
        """What is of each material, along a new axis `dim`, by what its surfaces enclose: it, and all on the same side
        of the medium before it."""
        stronger = dict[float, Tensor]()
        found = list[Tensor]()
        for material, one in zip(self.matter.channels, enclosed):
            found.append(one - stronger[material.sign] if material.sign in stronger else one)
            stronger[material.sign] = one
        return torch.stack(found, dim=dim)

    def mesh(self, name: str = "surfaces") -> TriangleMesh:
        """All surfaces as one mesh [m]."""
        vertices = self.vertices.detach().cpu().numpy() * self.unit_length
        return TriangleMesh(vertices, self.faces.cpu().numpy(), name)

    def bodies(self) -> list[TriangleMesh]:
        """One mesh [m] for each body, with its cavities, the largest first, named body000, body001 …

        Of several materials a body goes as far as the weakest inside it. `InputError` if no surface encloses matter.
        """
        return [joined(parts, f"body{k:03d}") for k, (_, parts) in enumerate(self._bodies())]

    def fillings(self) -> list[Matter]:
        """What is just inside each of the `bodies`."""
        return [Matter.one(*material) for material, _ in self._bodies()]

    def _bodies(self) -> list[tuple[DeltaBeta, list[TriangleMesh]]]:
        whole, found = self.mesh(), list[tuple[DeltaBeta, list[TriangleMesh]]]()
        for material, step in zip(self.matter.channels, self.steps):
            faces = step.cpu().numpy()
            labels = shell_labels(faces, len(whole.vertices))
            shells = [part_of(whole, faces[labels == k], "shell") for k in range(labels.max(initial=-1) + 1)]
            shells.sort(key=lambda shell: -shell.volume)
            outer = [shell for shell in shells if shell.volume > 0]
            members: list[list[TriangleMesh]] = [[shell] for shell in outer]
            for cavity in shells[len(outer) :] if outer else ():
                around = [round(winding_number(o.vertices[o.faces], cavity.vertices[0]), 3) for o in outer]
                smallest = max(range(len(outer)), key=lambda k: (around[k], k))  # outer ones are sorted by size
                members[smallest].append(cavity)
            found += [(material, parts) for parts in members]
        if not found:
            raise InputError("the surfaces enclose no matter: all of them bound cavities; check how they are wound.")
        return sorted(found, key=lambda one: -one[1][0].volume)


class MovingSurfaces:
    """Bodies with closed surfaces of the same triangles at all times, each vertex on a path; the paths are trainable.

    coefficients: [K, P, 3] float64 of the paths `(x, y, z)` in the basis, in units of `unit_length` [m], the scan's
    pixel size; faces: [F, 3] int64, as of `SurfaceMesh`; of_body: [F] int64, whose face each is, from 0 on; basis: of
    time; matter: the one material inside; lines: rows that are integrated in a pixel. A body is there at all times,
    beyond the field too. As it stands, the object is that of the first time. Errors: `InputError` if the arrays do
    not fit, or for more than one material.
    """

    kind: ClassVar[str] = "moving-surfaces"
    """The name of this kind of Object in files."""
    _repr_html_ = of_object

    def __init__(
        self,
        coefficients: Tensor,
        faces: Tensor,
        of_body: Tensor,
        basis: TimeBasis,
        unit_length: float,
        matter: Matter,
        lines: int = 2,
    ) -> None:
        shape = tuple(coefficients.shape)
        fits = len(shape) == 3 and shape[0] == basis.count and shape[2] == 3
        require(fits, f"paths need coefficients ({basis.count}, P, 3), but theirs have the shape {shape}.")
        require(
            of_body.shape == faces.shape[:1], f"each of {len(faces)} faces needs its body, but {len(of_body)} have one."
        )
        require(bool(coefficients.detach().isfinite().all()), "coefficients of paths must be finite numbers.")
        self.coefficients, self.faces, self.of_body, self.basis = coefficients, faces, of_body, basis
        self.unit_length, self.matter, self.lines, self.backend = float(unit_length), matter, lines, "cpu"
        self.at(basis.first)  # which checks the triangles

    @classmethod
    def of_bodies(
        cls, paths: Sequence[np.ndarray], faces: Sequence[np.ndarray], basis: TimeBasis, unit: float, matter: Matter
    ) -> MovingSurfaces:
        """From the coefficients [K, P, 3] [m] and the triangles [F, 3] of each body; unit: pixel size [m]."""
        require(len(paths) > 0, "moving surfaces need at least one body.")
        starts = np.cumsum([0, *(path.shape[1] for path in paths[:-1])])
        joined = np.concatenate([np.asarray(f, dtype=np.int64) + start for f, start in zip(faces, starts)])
        labels = np.repeat(np.arange(len(faces)), [len(f) for f in faces])
        coefficients = torch.from_numpy(np.concatenate(paths, axis=1) / unit)
        return cls(coefficients, torch.from_numpy(joined), torch.from_numpy(labels), basis, unit, matter)

    @property
    def count(self) -> int:
        """Number of bodies."""
        return int(self.of_body.max()) + 1

    def parameters(self) -> dict[str, Tensor]:
        """The trainable tensor, by name."""
        return {"coefficients": self.coefficients}

    def with_parameters(self, parameters: Mapping[str, Tensor]) -> MovingSurfaces:
        """The same triangles on other paths."""
        paths = parameters.get("coefficients", self.coefficients)
        return MovingSurfaces(paths, self.faces, self.of_body, self.basis, self.unit_length, self.matter, self.lines)

    def state(self) -> dict[str, Any]:
        """Tensors and plain values that `from_state` makes the same bodies of."""
        arrays = {"coefficients": self.coefficients, "faces": self.faces, "of_body": self.of_body}
        plain = {"basis": self.basis.as_dict(), "unit_length": self.unit_length, "lines": self.lines}
        return {**arrays, **plain, "matter": self.matter.as_dict()}

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> MovingSurfaces:
        """The bodies that `state` described; `InputError` where it does not fit together."""
        arrays = state["coefficients"], state["faces"].long(), state["of_body"].long()
        basis, unit = TimeBasis.from_dict(state["basis"]), positive("unit_length", state["unit_length"], "metres")
        faces, last = arrays[1], arrays[0].shape[1] - 1
        require(
            len(faces) > 0 and 0 <= int(faces.min()) <= int(faces.max()) <= last,
            f"faces must name vertices from 0 to {last}, but they do not.",
        )
        return cls(*arrays, basis, unit, Matter.from_dict(state["matter"]), int(state["lines"]))

    @property
    def described(self) -> str:
        """How large it is, in words."""
        of = f"degree {self.basis.degree}" + (f" in {self.basis.pieces} pieces" if self.basis.pieces > 1 else "")
        return f"{number_of(self.count, 'moving body')} of {len(self.faces)} triangles, paths of {of}"

    def on(self, backend: str) -> MovingSurfaces:
        """The bodies for another backend (resolved); their projector runs on the CPU."""
        bodies = self.with_parameters({})
        bodies.backend = in_main_memory(backend)
        return bodies

    def enclosing_grid(self, most_voxels: int) -> Grid:
        """A grid around all bodies at all times, as of `SurfaceMesh`: paths do not leave the hull of coefficients."""
        points = self.coefficients.detach().reshape(-1, 3).numpy()
        return Grid.around(points, self.unit_length, most_voxels)

    def at(self, time: float) -> SurfaceMesh:
        """The surfaces as they are at `time` [s], between frames too; beyond the frames paths go on."""
        vertices = path_positions(self.basis, self.coefficients, time)
        surfaces = SurfaceMesh(vertices, self.faces, self.unit_length, self.matter, self.lines)
        surfaces.backend = self.backend
        return surfaces

    def project(self, views: Views | Poses) -> LineIntegrals:
        """Line integrals (B, D) at the first time."""
        return self.at(self.basis.first).project(views)

    def voxelise(self, grid: Grid) -> Volume:
        """δ and β on `grid` at the first time."""
        return self.at(self.basis.first).voxelise(grid)

    def body(self, number: int) -> tuple[Tensor, Tensor]:
        """Which vertices [Q] a body has, and its faces [G, 3] among them."""
        own = self.faces[self.of_body == number]
        used, faces = torch.unique(own, return_inverse=True)
        return used, faces.reshape(-1, 3)

    def bodies(self, time: float) -> list[TriangleMesh]:
        """One mesh [m] for each body at `time` [s], named body000, body001 …, the same body at every time."""
        return self.parted(path_positions(self.basis, self.coefficients.detach(), time))

    def parted(self, vertices: Tensor) -> list[TriangleMesh]:
        """One mesh [m] for each body, named as those of `bodies`, of all their vertices [P, 3] [units of length]."""
        vertices, parts = self.unit_length * vertices, (self.body(k) for k in range(self.count))
        return [TriangleMesh(vertices[u].numpy(), f.numpy(), f"body{k:03d}") for k, (u, f) in enumerate(parts)]

    def velocities(self, time: float) -> list[np.ndarray]:
        """Velocities [P, 3] [m/s] of the vertices of each of `bodies` at `time` [s]."""
        speeds = self.unit_length * path_positions(self.basis, self.coefficients.detach(), time, 1)
        return [speeds[self.body(k)[0]].numpy() for k in range(self.count)]
