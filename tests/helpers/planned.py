"""A cell whose recording is planned."""

from __future__ import annotations

from holosplat.materials import PLASMA, RED_CELL
from holosplat.mesh import TriangleMesh
from holosplat.planning.contrast import Subject
from holosplat.specimens.red_cells import evans_fung_cell, icosphere

CELL = Subject(evans_fung_cell(8e-6, 4), RED_CELL, PLASMA)


def ellipsoid(x: float, y: float, z: float, level: int = 4) -> TriangleMesh:
    """Half-axes [m]."""
    sphere, faces = icosphere(level)
    return TriangleMesh(sphere * [x, y, z], faces, "ellipsoid")
