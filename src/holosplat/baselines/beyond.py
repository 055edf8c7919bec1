"""Matter that goes on beyond the frames: in how many rows above and below, and columns at the sides, a volume has it.

Fringes of what lies a few rows beyond a frame reach into it, and soft matter is seen by how its shadow bends from row
to row. A volume that ends with the frames has air there instead, and is wrong far into them. Matter at the sides lies
on the rays of other views (interior tomography).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import pad

from ..geometry import Grid, Views
from ..optics.noise import noise_levels
from ..optics.retrieval import absorption_alone
from ..optics.sampling import fringe_reach, fringe_sampling
from ..scan import Scan

OUTER, LEAVING, FINE = 2, 0.15, 0.1
"""Rows at the top and at the bottom, the part of the mean occupancy from which on matter goes on there, and the part of
the mean square slope along a row of the frames: uneven light may pass for matter, but has no fine structure."""
SURE = 4.0
"""Standard deviations of chance by which noise may have this fine structure there."""
ROOM = 2
"""Rows beyond the reach of fringes and blur, for what a volume cannot have in its outermost ones."""
MULTIPLE = 4
"""Rows and columns beyond are a multiple of so many, so that larger pixels divide them, too."""
Margins = tuple[int, int]
"""Rows above and below, and columns on either side."""


def rows_beyond(volume: Tensor, scan: Scan, ratio: float) -> int:
    """Rows above and below the frames of `scan` in which there is matter that acts on them.

    volume: a first one [Z, Y, X], with a voxel for each row. 0 where its outermost slices have next to nothing, where
    the outermost rows of the frames have no fine structure, and where frames of a material of β/δ = `ratio` show
    absorption alone, which is seen where it is. Else the fringes' reach with the blur, and `ROOM`.
    """
    exposures, frames = scan.exposures, torch.from_numpy(scan.frames).double()
    noise = 2 * float(noise_levels(scan.measured).square().mean())
    slopes = frames.diff(dim=2).square().mean(dim=(0, 2)) - noise
    chance = noise * math.sqrt(3 / (OUTER * len(frames) * frames.shape[2]))  # 3: neighbouring slopes share a pixel
    for rows, part, doubt in ((volume.abs().mean(dim=(0, 2)), LEAVING, 0.0), (slopes, FINE, SURE * chance)):
        outer = max(float(rows[:OUTER].mean()), float(rows[-OUTER:].mean()))
        if outer <= part * float(rows.mean()) + doubt:
            return 0
    if absorption_alone(exposures, ratio).all():
        return 0
    return MULTIPLE * math.ceil((fringe_reach(exposures, fringe_sampling(exposures)) + ROOM) / MULTIPLE)


def columns_beyond(views: Views, share: float) -> int:
    """Columns on either side of the frames of `views` in which a volume has matter: this `share` of them.

    Matter that leaves the frames sideways lies on the rays of other views. A volume that ends with the frames takes it
    for matter inside.
    """
    return MULTIPLE * math.ceil(share * views.shape[1] / MULTIPLE)


def carried_on(images: Tensor, rows: int, columns: int = 0) -> Tensor:
    """Images [V, H, W] with `rows` more above and below, and `columns` at either side, as their outermost ones."""
    return pad(images[None], (columns, columns, rows, rows), mode="replicate")[0] if rows or columns else images


def margins_of(grid: Grid, views: Views) -> Margins:
    """Rows above and below the frames of `views`, and columns at either side, that a volume on `grid` has."""
    size = (grid.shape[1] * grid.voxel_size[1], grid.shape[2] * grid.voxel_size[0])
    rows, columns = (max(0, round(0.5 * (n / views.finest - seen))) for n, seen in zip(size, views.shape))
    return rows, columns


def unseen_rays(scan: Scan, beyond: Margins) -> Tensor | None:
    """Rays [V, H, W] bool, with those `beyond` the frames, that say nothing: of missing pixels, and at the sides."""
    rows, columns = beyond
    if scan.gaps is None and columns == 0:
        return None
    inside = torch.zeros(len(scan), *scan.views.shape, dtype=torch.bool) if scan.gaps is None else scan.gaps
    return pad(carried_on(inside.float(), rows), (columns, columns), value=1.0) > 0
