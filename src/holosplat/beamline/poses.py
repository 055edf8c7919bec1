"""Directions of views: evenly spaced, listed, tilted, as matrices, or of a known beamline."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from ..checks import require, require_regular
from ..io.guard import read_array
from ..ranges import Many, Signed, ranged

if TYPE_CHECKING:
    from ..geometry import Views

Geometry = Literal["thesis16", "xmpi_2beam", "xmpi_3beam"]

GEOMETRIES: dict[Geometry, tuple[float, ...]] = {
    "thesis16": tuple(180 / 16 * n for n in range(16)),
    "xmpi_2beam": (0.0, 23.8),
    "xmpi_3beam": (0.0, 30.0, 48.0),
}
"""Angles [degrees] about y: the thesis' sixteen views, and beams split by crystals (X-ray multi-projection imaging)."""


@dataclass(frozen=True)
@ranged
class Directions:
    """The views of an experiment: exactly one of `views`, `angles_deg`, `rotations` and `geometry`."""

    views: Many | None = None
    """Number of views, evenly spaced over 180°."""
    angles_deg: tuple[Signed, ...] = ()
    """Angles about the rotation axis [degrees]."""
    tilts_deg: tuple[Signed, ...] = ()
    """Tilts of the beam out of the plane normal to the axis [degrees], one an angle (default: none)."""
    rotations: Path | None = None
    """File (.npy) of rotation matrices [V, 3, 3]."""
    geometry: Geometry | None = None
    """Name of a known geometry, a key of `GEOMETRIES`."""

    def on(self, shape: tuple[int, int], pixel_size: float) -> Views:
        """The views on a detector of `shape` pixels of `pixel_size` [m]; `InputError` unless one way is named."""
        from ..geometry import Views, rotation_tilted  # torch is slow to import; the command line needs the names alone

        angles = GEOMETRIES[self.geometry] if self.geometry else self.angles_deg
        given = (self.views is not None) + bool(self.angles_deg) + (self.rotations is not None) + bool(self.geometry)
        require(given == 1, "give exactly one of --views, --angles-deg, --rotations and --geometry.")
        require(not self.tilts_deg or bool(self.angles_deg), "--tilts-deg needs --angles-deg, one tilt for each angle.")
        if self.rotations is not None:
            return Views.from_rotations(_matrices(self.rotations), shape, pixel_size)
        if self.views is not None:
            return Views.evenly_spaced(self.views, shape, pixel_size)
        tilts = self.tilts_deg or (0.0,) * len(angles)
        return Views.from_rotations(rotation_tilted(list(angles), list(tilts)), shape, pixel_size)


def _matrices(path: Path) -> np.ndarray:
    require_regular(path, "rotation matrices (V, 3, 3), of --rotations,")
    matrices = read_array(path, "rotation matrices (V, 3, 3), of --rotations,")
    numeric = matrices.dtype.kind in "fiu" and matrices.ndim == 3
    require(numeric, f"--rotations must hold numbers of the shape (V, 3, 3) as .npy, but {path} does not.")
    return matrices
