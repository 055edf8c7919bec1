"""From mesh files to a scene (`holosplat simulate`)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ..checks import require
from ..io.vtk import read_meshes
from ..materials import HAEMOGLOBIN, DeltaBeta, Material, material_of
from ..specimens.repair import closed
from ..specimens.scene import MeshScene
from ..units import LENGTH_UNITS, unit_factor

FARTHEST = 1.0
"""Metres from the files' origin within which a field of view lies."""


@dataclass(frozen=True)
class Filling:
    """The materials of mesh files and the medium around them."""

    material: Material | None = HAEMOGLOBIN
    """Material of meshes that no pattern of `table` matches (None: every mesh must match one)."""
    medium: Material | None = None
    """Material around the meshes; δ and β are differences to it (None: vacuum)."""
    table: dict[str, Material] = field(default_factory=dict)
    """File-name pattern → material of the meshes that it matches."""

    def of(self, name: str, energy_kev: float) -> DeltaBeta:
        """δ and β of the mesh file `name` against the medium, at `energy_kev` [keV]."""
        inside = material_of(name, self.table, self.material).delta_beta(energy_kev)
        return inside.against(self.medium.delta_beta(energy_kev)) if self.medium else inside


def read_scene(
    paths: Sequence[Path],
    filling: Filling,
    energy_kev: float,
    *,
    length_unit: str = "um",
    origin: tuple[float, float, float] | None = None,
) -> MeshScene:
    """Closed meshes from VTK files, filled, and centred on the rotation axis.

    origin: the point (x, y, z), in the files' coordinates and unit, that lies on the rotation axis at the
    centre of the field of view (default: the centre of the common bounding box).
    """
    scene = filled_scene(paths, filling, energy_kev, length_unit)
    return scene.moved(-field_centre(scene.bounds, origin, length_unit))


def filled_scene(paths: Sequence[Path], filling: Filling, energy_kev: float, length_unit: str) -> MeshScene:
    """Closed meshes from VTK files, filled, where the files have them."""
    meshes = [closed(mesh, length_unit) for mesh in read_meshes(paths, length_unit)]
    return MeshScene(tuple(meshes), tuple(filling.of(mesh.name, energy_kev) for mesh in meshes))


def field_centre(
    bounds: tuple[np.ndarray, np.ndarray], origin: tuple[float, float, float] | None, length_unit: str
) -> np.ndarray:
    """The point (x, y, z) [m] at the field's centre: `origin`, in `length_unit`, or the middle of `bounds` [m]."""
    if origin is None:
        return 0.5 * (bounds[0] + bounds[1])
    require(bool(np.all(np.isfinite(origin))), f"origin must be three finite numbers, but it is {origin}.")
    point = unit_factor("length unit", length_unit, LENGTH_UNITS) * np.array(origin)
    require(
        bool((np.abs(point) <= FARTHEST).all()),
        f"origin must lie within {FARTHEST:g} m, but it is {origin} {length_unit}.",
    )
    return point
