"""A body of known shape in unknown pose, or beads of known radius in unknown places: what calibrates beams."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from ..checks import positive, require
from ..matter import DeltaBeta, Matter
from ..mesh import TriangleMesh
from ..representations import SurfaceMesh
from ..specimens.red_cells import icosphere

FINENESS = 3
"""Bisections of an icosahedron that stands for a bead: 1280 triangles, off a ball by 0.4 % of the radius."""


@dataclass(frozen=True)
class Phantom:
    """N bodies of known shape.

    shapes: [N] closed meshes [m], each about its own centre of mass; places: [N, 3] of these centres, object frame [m];
    turn: [3, 3] of all shapes about them; free: whether the places are unknown, beside a motion of all together.
    """

    shapes: tuple[TriangleMesh, ...]
    places: np.ndarray
    turn: np.ndarray
    free: bool

    @classmethod
    def of_mesh(cls, mesh: TriangleMesh) -> Phantom:
        """A rigid body; where its file puts it does not matter."""
        centre = centre_of_mass(mesh)
        return cls((mesh.transformed(np.eye(3), -centre),), np.zeros((1, 3)), np.eye(3), False)

    @classmethod
    def of_beads(cls, places: np.ndarray, radius: float) -> Phantom:
        """Balls of `radius` [m] at `places` [N, 3] [m], as polyhedra of their volume."""
        vertices, faces = icosphere(FINENESS)
        ball = TriangleMesh(positive("the beads' radius", radius, "metres") * vertices, faces, "bead")
        ball = replace(ball, vertices=ball.vertices * (4 / 3 * np.pi * radius**3 / ball.volume) ** (1 / 3))
        require(len(places) > 0, "a phantom of beads needs one bead at least; check --beads and the material.")
        return cls((ball,) * len(places), np.array(places, dtype=np.float64), np.eye(3), True)

    def __len__(self) -> int:
        return len(self.shapes)

    @property
    def unknowns(self) -> int:
        """Numbers of the bodies that are found beside those of the views."""
        return 3 * len(self) if self.free else 0

    def moved(self, turn: np.ndarray, by: np.ndarray) -> Phantom:
        """All of it turned [3, 3] about the origin and then moved [3] [m]."""
        return replace(self, places=self.places @ turn.T + by, turn=turn @ self.turn)

    def shifted(self, by: np.ndarray) -> Phantom:
        """The bodies moved by [N, 3] [m], each by itself."""
        return replace(self, places=self.places + by)

    def mesh(self, n: int) -> TriangleMesh:
        """Body `n` where it is [m]."""
        return self.shapes[n].transformed(self.turn, self.places[n])

    def surfaces(self, material: DeltaBeta, pixel: float, only: Sequence[int] | None = None) -> SurfaceMesh:
        """All bodies, or `only` some, filled with `material`, in units of `pixel` [m]."""
        meshes = [self.mesh(n) for n in (range(len(self)) if only is None else only)]
        starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
        faces = np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts)])
        vertices = np.concatenate([mesh.vertices for mesh in meshes]) / pixel
        matter = Matter.one(material.delta, material.beta)
        return SurfaceMesh(torch.from_numpy(vertices), torch.from_numpy(faces), pixel, matter)


def centre_of_mass(mesh: TriangleMesh) -> np.ndarray:
    """That [3] of the inside of a closed mesh [m]: of tetrahedra from one point (divergence theorem)."""
    origin = mesh.vertices.mean(0)
    a, b, c = np.moveaxis((mesh.vertices - origin)[mesh.faces], 1, 0)
    volumes = np.einsum("fi,fi->f", a, np.cross(b, c))
    total = float(volumes.sum())
    require(total > 0, f"{mesh.name} must be a closed mesh wound outwards, but it encloses no volume; repair it.")
    return origin + volumes @ (a + b + c) / (4 * total)
