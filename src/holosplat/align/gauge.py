"""The gauge freedom of poses: a common motion of the whole object, which no frame determines."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from ..geometry import Views


def moved_onto(found: Views, planned: Views) -> Views:
    """`found` with the object turned and moved so that its views are as near to `planned` as can be.

    The common turn is the mean of all relative ones, the common motion the least-squares one: mean turn and mean shift
    of the views are then zero. Frames stay what they are.
    """
    turns = np.einsum("vji,vjk->vik", found.rotations, planned.rotations)
    rotations = found.rotations @ Rotation.from_matrix(turns).mean().as_matrix()
    design = rotations[:, :2].reshape(-1, 3)
    away = (found.shifts - planned.shifts).reshape(-1)
    motion = np.linalg.lstsq(design, away, rcond=1e-9)[0]
    return replace(found, rotations=rotations, shifts=found.shifts - (design @ motion).reshape(-1, 2))
