"""Rotation matrices of tomographic angles (docs/conventions.md)."""

from __future__ import annotations

import numpy as np

from .checks import InputError, finite, require


def rotation_y(angles_deg: np.ndarray | list[float]) -> np.ndarray:
    """Rotation matrices [V, 3, 3] of tomographic angles [V] in degrees about y (docs/conventions.md)."""
    angles = np.asarray(angles_deg, dtype=np.float64).reshape(-1)
    for angle in angles[~np.isfinite(angles)]:
        raise InputError(f"every angle must be a finite number of degrees, but one is {angle:g}; correct it.")
    theta = np.deg2rad(angles)
    c, s, o, i = np.cos(theta), np.sin(theta), np.zeros_like(theta), np.ones_like(theta)
    return np.stack([np.stack([c, o, s], -1), np.stack([o, i, o], -1), np.stack([-s, o, c], -1)], -2)


def angles_about_y(rotations: np.ndarray) -> np.ndarray:
    """Angles [V] in radians, from -π to π, of `rotation_y`, by where it turns the x axis of rotations [V, 3, 3]."""
    return np.arctan2(rotations[:, 0, 2], rotations[:, 0, 0])


def rotation_tilted(angles_deg: np.ndarray | list[float], tilts_deg: np.ndarray | list[float]) -> np.ndarray:
    """Rotation matrices [V, 3, 3] of angles [V] about y, tilted [V] out of the plane: `R = R_x(tilt) R_y(angle)`.

    Both in degrees; the tilt is by how much the beam leaves the plane that is normal to the object's y axis, so that
    the views have no common axis. Errors: `InputError` for values that are not finite, and unless they are as many.
    """
    tilts = finite("tilt", np.asarray(tilts_deg, dtype=np.float64).reshape(-1))
    turned = rotation_y(angles_deg)
    require(
        len(tilts) == len(turned),
        f"there must be one tilt for each of the {len(turned)} angles, but there are {len(tilts)}.",
    )
    c, s = np.cos(np.deg2rad(tilts)), np.sin(np.deg2rad(tilts))
    o, i = np.zeros_like(c), np.ones_like(c)
    return np.stack([np.stack([i, o, o], -1), np.stack([o, c, -s], -1), np.stack([o, s, c], -1)], -2) @ turned
