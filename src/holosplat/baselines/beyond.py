"""Matter that goes on above and below the frames: in how many rows there a volume must have it.

Fringes of what lies a few rows beyond a frame reach into it, and soft matter is seen by how its shadow bends from row
to row. A volume that ends with the frames has air there instead, and is wrong far into them.
"""

from __future__ import annotations

import math

import numpy as np
from torch import Tensor
from torch.nn.functional import pad

from ..geometry import Grid, Views
from ..optics.retrieval import absorption_alone
from ..optics.sampling import fringe_reach, fringe_sampling
from ..scan import Exposures

OUTER, LEAVING = 2, 0.1
"""Rows at the top and at the bottom, and the part of the mean thickness from which on matter goes on there."""
ROOM = 2
"""Rows beyond the reach of fringes and blur, for what a volume cannot have in its outermost ones."""
MULTIPLE = 4
"""Rows beyond are a multiple of so many, so that larger pixels divide them, too."""


def rows_beyond(lines: Tensor, exposures: Exposures, ratio: float) -> int:
    """Rows above and below frames in which there is matter that acts on them, by their thickness `lines` [V, H, W].

    0 where the outermost rows have next to nothing, and where frames of a material of β/δ = `ratio` show absorption
    alone, which is seen where it is. Else the fringes' reach with the blur, and `ROOM`.
    """
    outer = 0.5 * (lines[:, :OUTER].mean() + lines[:, -OUTER:].mean())
    if float(outer) <= LEAVING * float(lines.mean()) or bool(np.all(absorption_alone(exposures, ratio))):
        return 0
    return MULTIPLE * math.ceil((fringe_reach(exposures, fringe_sampling(exposures)) + ROOM) / MULTIPLE)


def carried_on(images: Tensor, rows: int) -> Tensor:
    """Images [V, H, W] with `rows` more above and below, as their outermost ones: [V, H + 2 rows, W]."""
    return pad(images[None], (0, 0, rows, rows), mode="replicate")[0] if rows else images


def rows_of(grid: Grid, views: Views) -> int:
    """Rows above and below the frames of `views` that a volume on `grid` has."""
    return max(0, round(0.5 * (grid.shape[1] * grid.voxel_size[1] / views.finest - views.shape[0])))
