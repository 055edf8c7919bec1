"""Closed surfaces that move and deform on smooth paths, as an Object."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from ..backends import in_main_memory
from ..checks import positive, require
from ..display import of_object
from ..geometry import Grid, Poses, Views
from ..matter import Matter
from ..mesh import TriangleMesh
from ..volume import LineIntegrals, Volume
from .paths import TimeBasis, path_positions
from .surfaces import SurfaceMesh


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
        return f"{self.count} moving bodies of {len(self.faces)} triangles, paths of {of}"

    def on(self, backend: str) -> MovingSurfaces:
        """The bodies for another backend (resolved); their projector runs on the CPU."""
        bodies = self.with_parameters({})
        bodies.backend = in_main_memory(backend)
        return bodies

    @property
    def stored_bytes(self) -> int:
        """Size of coefficients as float32 and faces as int32."""
        return 4 * (self.coefficients.numel() + self.faces.numel())

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
