"""Gaussians that fill closed surfaces: where large frames start, if Gaussians are wanted."""

from __future__ import annotations

import torch
from torch import Tensor

from ..geometry import Grid
from ..projectors.surface import surface_occupancy
from ..representations import GaussianCloud, SurfaceMesh
from ..representations.octree import cloud_in_octree
from .coarse import CoarseToFine
from .method import Task

MOST_VOXELS = 1 << 25
"""Voxels that are looked at together: an array of them is 134 MB."""
MOST_GAUSSIANS = 3_000_000
"""Gaussians at most; beyond, all are twice as large."""


def cloud_of_surfaces(mesh: SurfaceMesh, task: Task, how: CoarseToFine) -> GaussianCloud:
    """Gaussians that fill the volume of `mesh` on voxels of a pixel of the frames of `task`."""
    grid = Grid.of_views(task.scan.views)
    occupancy = occupancy_of(mesh, grid)
    edge, channel = 1, mesh.matter.channels[0]
    found = cloud_in_octree(occupancy, grid, channel, mesh.unit_length, how.sizes)
    while len(found) > MOST_GAUSSIANS:
        edge *= 2
        found = cloud_in_octree(occupancy, grid, channel, mesh.unit_length, how.sizes, edge)
    return found


def occupancy_of(mesh: SurfaceMesh, grid: Grid) -> Tensor:
    """The part of each voxel of `grid` that is inside, float32 [Z, Y, X], some rows at a time: its own arrays are
    float64, and of the triangles only those count that reach into the rows."""
    voxel, origin = (torch.tensor(values, dtype=torch.float64) for values in (grid.voxel_size, grid.origin))
    vertices = (mesh.vertices.detach() * mesh.unit_length - origin) / voxel
    heights = vertices[:, 1][mesh.faces]
    low, high = heights.amin(dim=1), heights.amax(dim=1)
    found, (depth, height, width) = torch.zeros(grid.shape), grid.shape
    rows = max(1, MOST_VOXELS // (8 * depth * width))
    for first in range(0, height, rows):
        count = min(rows, height - first)
        faces = mesh.faces[(high >= first - 1) & (low <= first + count)]
        if len(faces):
            moved = vertices - torch.tensor([0.0, first, 0.0], dtype=torch.float64)
            found[:, first : first + count] = surface_occupancy(moved, faces, (depth, count, width))
    return found.clamp_(min=0)  # of rounding
