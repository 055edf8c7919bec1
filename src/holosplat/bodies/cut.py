"""Bodies cut out of the occupancy of a volume, one mesh each."""

from __future__ import annotations

import numpy as np
import torch

from ..checks import InputError
from ..geometry import Grid, Views
from ..matter import Matter
from ..mesh import TriangleMesh
from ..representations import SurfaceMesh, isosurface
from .touching import parted

LEVEL, LEAST_VOLUME, SMOOTHING, EDGE = 0.5, 30.0, 10, 1.0
"""Occupancy at the surface; pixels³ of the smallest body; steps that smooth away the voxels' traces; and distance from
the field's edge [pixels] within which a body is cut by it."""


def cut_bodies(
    values: np.ndarray,
    grid: Grid,
    pixel: float,
    level: float = LEVEL,
    least_volume: float = LEAST_VOLUME,
    smoothing: int = SMOOTHING,
) -> list[TriangleMesh]:
    """The bodies [m] where occupancy `values` [Z, Y, X] on `grid` is above `level`, the largest first; such as touch
    are parted. None where nothing reaches the level, or cavities alone do.

    pixel: of the frames [m]; least_volume: of a body [pixels³]
    """
    least = least_volume * (pixel / grid.voxel_size[0]) ** 3
    try:
        mesh = isosurface(parted(values, level, least), grid, level, least, smoothing)
        unit = torch.from_numpy(mesh.vertices / pixel)
        return SurfaceMesh(unit, torch.from_numpy(mesh.faces), pixel, Matter.one(1.0, 1.0)).bodies()
    except InputError:
        return []


def is_cut(body: TriangleMesh, views: Views, edge: float = EDGE) -> bool:
    """Whether `body` comes within `edge` pixels of the rows' ends in any view, or of the columns' in all of them.

    What one view's columns cut, others may see whole; rows are common to all views about one axis, but need not be.
    """
    seen = np.einsum("vij,pj->vpi", views.rotations[:, :2], body.vertices) - views.shifts[:, None]
    rows, columns = views.shape
    half = 0.5 * np.array([columns, rows]) * views.pixel_sizes[:, None] - edge * views.pixel_sizes[:, None]
    beyond = (np.abs(seen) > half[:, None]).any(1)  # [V, 2]: of columns, of rows
    return bool(beyond[:, 1].any() or beyond[:, 0].all())
