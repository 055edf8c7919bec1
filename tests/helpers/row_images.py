"""Images of views that are elsewhere, by closed forms: what rows of beams in one plane are tested with."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from holosplat.geometry import Views

POINTS = ((4.0, -3.0, 5.0, 2.0), (-6.0, 2.0, 1.0, 1.0), (1.0, 6.0, -7.0, 1.5))
WIDTH = 3.0


def gaussians(views: Views) -> np.ndarray:
    """Projections [V, H, W] of round Gaussians, lengths in pixels."""
    (h, w), made = views.shape, []
    x, y = np.arange(w) + 0.5 - w / 2, np.arange(h)[:, None] + 0.5 - h / 2
    for rotation, shift in zip(views.rotations, views.shifts):
        at = [(rotation[:2] @ np.array(point[:3]) - shift, point[3]) for point in POINTS]
        made.append(sum(m * np.exp(-((x - a[0]) ** 2 + (y - a[1]) ** 2) / (2 * WIDTH**2)) for a, m in at))
    return np.array(made)


def placed(numbers: np.ndarray, planned: Views) -> Views:
    """Planned views with numbers [V, 5]."""
    rotations = Rotation.from_rotvec(numbers[:, 2:5]).as_matrix() @ planned.rotations
    return replace(planned, rotations=rotations, shifts=planned.shifts + numbers[:, :2])
