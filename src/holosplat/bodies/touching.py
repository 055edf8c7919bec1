"""Bodies that touch in a volume: a body much larger than the others is parted where its occupancy dips."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

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
