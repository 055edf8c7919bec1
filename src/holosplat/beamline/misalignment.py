"""Beamlines that are not where they say: errors of each view's pose and distance, drawn by a seed."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from ..checks import require
from ..ranges import Angle, Pixels, Seed, ranged
from ..scan import Exposures

MOST_SHIFT_PX, MOST_ROTATION_DEG, MOST_DISTANCE, MOST_MAGNIFICATION = 1000.0, 45.0, 0.1, 0.1


@dataclass(frozen=True)
@ranged
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
