"""From mesh files to a scan: what `holosplat simulate` does."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ..checks import require
from ..geometry import Views
from ..io.vtk import read_meshes
from ..materials import HAEMOGLOBIN, DeltaBeta, Material, material_of
from ..specimens.repair import closed
from ..specimens.scene import MeshScene
from ..units import LENGTH_UNITS, unit_factor


@dataclass(frozen=True)
class Filling:
    """What fills the meshes: `material`, unless a file-name pattern of `table` matches, and what surrounds them.

    With `material=None` every mesh must match a pattern.
    """

    material: Material | None = HAEMOGLOBIN
    medium: Material | None = None
    table: dict[str, Material] = field(default_factory=dict)

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
    if origin is not None:
        require(bool(np.all(np.isfinite(origin))), f"origin must be three finite numbers, but it is {origin}.")
    meshes = [closed(mesh, length_unit) for mesh in read_meshes(paths, length_unit)]
    scene = MeshScene(tuple(meshes), tuple(filling.of(mesh.name, energy_kev) for mesh in meshes))
    low, high = scene.bounds
    unit = unit_factor("length unit", length_unit, LENGTH_UNITS)
    return scene.moved(-0.5 * (low + high) if origin is None else -unit * np.array(origin))


def poses(
    views: int | None,
    angles_deg: Sequence[float],
    rotations: Path | None,
    shape: tuple[int, int],
    pixel_size: float,
) -> Views:
    """Evenly spaced views, a list of angles, or rotation matrices [V, 3, 3] from a .npy file; exactly one of them."""
    given = (views is not None) + (len(angles_deg) > 0) + (rotations is not None)
    require(given == 1, "give exactly one of --views, --angles-deg and --rotations.")
    if rotations is not None:
        require(
            rotations.is_file(),
            f"--rotations must name a .npy file of matrices, but {rotations} does not exist.",
        )
        try:
            matrices = np.load(rotations, allow_pickle=False)
        except (ValueError, OSError, EOFError):
            matrices = np.empty(0)
        numeric = matrices.dtype.kind in "fiu" and matrices.ndim == 3
        require(
            numeric,
            f"--rotations must hold numbers of the shape (V, 3, 3) as .npy, but {rotations} does not.",
        )
        return Views.from_rotations(matrices, shape, pixel_size)
    if angles_deg:
        return Views.from_angles(list(angles_deg), shape, pixel_size)
    assert views is not None
    return Views.evenly_spaced(views, shape, pixel_size)
