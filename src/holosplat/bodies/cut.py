"""Bodies cut out of the occupancy of a volume, one mesh each."""

from __future__ import annotations

import numpy as np
import torch
from scipy import ndimage

from ..checks import InputError
from ..geometry import Grid, Views
from ..matter import Matter
from ..mesh import TriangleMesh
from ..representations import SurfaceMesh, isosurface

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


LARGE = 1.3
"""Volumes, over the median one, from which on a body may be two: volumes of one body differ by less."""
PIECE = 0.1
"""Share of the median volume that each piece has at least, at the level at which it comes off."""
LEVELS = 10
"""Levels between the surface's and the largest occupancy at which pieces may come off."""


def parted(values: np.ndarray, level: float, least: float) -> np.ndarray:
    """Occupancy [Z, Y, X] in which bodies that touch are parted by empty voxels.

    level: occupancy at the surface; least: voxels of the bodies that count. Of a body of more than `LARGE` median
    volumes the level is raised until it falls into pieces, from which it is flooded again (watershed by markers:
    Meyer & Beucher 1990); voxels at which two floods meet are emptied.
    """
    bodies, sizes = _labelled(values > level)
    counted = sizes[sizes >= least]
    if len(counted) < 2:
        return values
    median, found = float(np.median(counted)), values.copy()
    levels = level + (float(values.max()) - level) * np.arange(1, LEVELS) / LEVELS
    for number in np.flatnonzero(sizes > LARGE * median) + 1:
        _part(found, bodies == number, levels, median)
    return found


def _part(values: np.ndarray, body: np.ndarray, levels: np.ndarray, median: float) -> None:
    """Empty the voxels of `values` where the pieces of one body meet."""
    from skimage.segmentation import watershed

    if body.sum() <= LARGE * median:
        return
    for k, level in enumerate(levels):
        pieces, sizes = _labelled(body & (values > level))
        own = np.flatnonzero(sizes >= PIECE * median) + 1
        if not len(own):
            return
        if len(own) > 1:
            flooded = watershed(-values, np.where(np.isin(pieces, own), pieces, 0), mask=body, watershed_line=True)
            values[body & (flooded == 0)] = 0
            for piece in own:
                _part(values, flooded == piece, levels[k + 1 :], median)
            return


def _labelled(mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Numbers [Z, Y, X] of what hangs together, from 1 on, and how many voxels each has."""
    found = np.empty(mask.shape, dtype=np.int32)
    count = int(ndimage.label(mask, output=found))  # pyright: ignore[reportArgumentType] (a number where output is given)
    return found, np.bincount(found.ravel(), minlength=count + 1)[1:]
