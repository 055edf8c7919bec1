"""Beamlines that are not where they say: errors of each view by a seed; and poses that a file lists."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from ..checks import require, require_regular
from ..io.guard import read_array
from ..ranges import Angle, Many, Pixels, Seed, Signed, checked_dataclass
from ..scan import Exposures

if TYPE_CHECKING:
    from ..geometry import Views

MOST_SHIFT_PX, MOST_ROTATION_DEG, MOST_DISTANCE, MOST_MAGNIFICATION = 1000.0, 45.0, 0.1, 0.1


@checked_dataclass
class Misalignment:
    """Standard deviations of the errors of each view, all independent and normally distributed.

    Errors: `InputError` for values below 0 or too large to be errors of alignment.
    """

    shift_px: Pixels = 0.0
    """Shifts of the detector along rows and along columns [pixels] (default: none)."""
    rotation_deg: Angle = 0.0
    """Small turns about x, y and z of the lab frame [degrees] (default: none)."""
    distance: float = 0.0
    """Relative error of the propagation distance (default: none)."""
    seed: Seed = 0
    """Seed of the errors."""
    magnification: float = 0.0
    """Relative error of the magnification (default: none)."""

    def __post_init__(self) -> None:
        limits = {"shift_px": MOST_SHIFT_PX, "rotation_deg": MOST_ROTATION_DEG, "distance": MOST_DISTANCE}
        limits["magnification"] = MOST_MAGNIFICATION
        for name, most in limits.items():
            value = getattr(self, name)
            inside = math.isfinite(value) and 0 <= value <= most
            require(inside, f"misalignment {name} must lie between 0 and {most:g}, but it is {value:g}.")

    def __bool__(self) -> bool:
        return max(self.shift_px, self.rotation_deg, self.distance, self.magnification) > 0

    def true_exposures(self, nominal: Exposures) -> Exposures:
        """The true exposures [V] of the planned ones, `nominal`: `R' = exp([ω]×) R`, `s' = s + p e`, `z' = z (1 + ε)`.

        The true pixel in the sample's plane is `p' = p / (1 + m)`. ω, e, ε and m come from generators of their own, so
        that one kind of error does not change with another's size.
        """
        from scipy.spatial.transform import Rotation

        count, views = len(nominal), nominal.views
        of_turn, of_shift, of_distance, of_scale = (np.random.default_rng([self.seed, kind]) for kind in range(4))
        turns = np.deg2rad(self.rotation_deg) * of_turn.standard_normal((count, 3))
        shifts = self.shift_px * views.pixel_sizes[:, None] * of_shift.standard_normal((count, 2))
        stretched = 1 + self.distance * of_distance.standard_normal(count)
        scales = views.relative / (1 + self.magnification * of_scale.standard_normal(count))
        rotations = Rotation.from_rotvec(turns).as_matrix() @ views.rotations
        return replace(
            nominal,
            views=replace(views, rotations=rotations, shifts=views.shifts + shifts, scales=scales),
            distance=nominal.distance * stretched,
        )


AS_PLANNED = Misalignment()
"""No errors."""


Geometry = Literal["thesis16", "xmpi_2beam", "xmpi_3beam"]

GEOMETRIES: dict[Geometry, tuple[float, ...]] = {
    "thesis16": tuple(180 / 16 * n for n in range(16)),
    "xmpi_2beam": (0.0, 23.8),
    "xmpi_3beam": (0.0, 30.0, 48.0),
}
"""Angles [degrees] about y: the thesis' sixteen views, and beams split by crystals (X-ray multi-projection imaging)."""


@checked_dataclass
class Directions:
    """The views of an experiment: exactly one of `views`, `angles_deg`, `rotations` and `geometry`."""

    views: Many | None = None
    """Number of views, evenly spaced over 180°."""
    angles_deg: tuple[Signed, ...] = ()
    """Or: the views' angles about the rotation axis [degrees]."""
    tilts_deg: tuple[Signed, ...] = ()
    """With these: how far each view leaves the plane normal to the axis [degrees]."""
    rotations: Path | None = None
    """Or: a .npy file of rotation matrices [V, 3, 3], x_lab = R x_obj."""
    geometry: Geometry | None = None
    """Or: a known geometry: 16 even views, or two beams (0°, 23.8°) or three (0°, 30°, 48°) at once."""

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
