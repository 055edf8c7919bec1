"""Gaussians that fill closed surfaces: where large frames start, if Gaussians are wanted."""

from __future__ import annotations

import torch
from torch import Tensor

from ..geometry import Grid
from ..projectors.surface import surface_occupancy
from ..representations import GaussianCloud, SurfaceMesh, approximate
from ..representations.octree import cloud_in_octree
from .coarse import CoarseToFine
from .method import Task

MOST_VOXELS = 1 << 25
"""Voxels that are looked at together: an array of them is 134 MB."""
EDGE = 64
"""Voxels along an edge of the blocks of the volume that Gaussians learn; empty ones are left out."""
MOST_GAUSSIANS = 2_000_000
"""Gaussians at most; beyond, all are twice as large."""


def cloud_of_surfaces(mesh: SurfaceMesh, task: Task, how: CoarseToFine) -> GaussianCloud:
    """Gaussians that approximate the volume of `mesh` on voxels of a pixel of the frames of `task`."""
    grid = Grid.of_views(task.scan.views)
    occupancy = occupancy_of(mesh, grid)
    edge, channel = 1, mesh.matter.channels[0]
    found = cloud_in_octree(occupancy, grid, channel, mesh.unit_length, how.sizes)
    while len(found) > MOST_GAUSSIANS:
        edge *= 2
        found = cloud_in_octree(occupancy, grid, channel, mesh.unit_length, how.sizes, edge)
    return approximate(found, occupancy, grid, how.volume_steps, task.on_progress, edge=EDGE)


def occupancy_of(mesh: SurfaceMesh, grid: Grid) -> Tensor:
    """The part of each voxel of `grid` that is inside, float32 [Z, Y, X], slab by slab: its own arrays are float64."""
    voxel, origin = (torch.tensor(values, dtype=torch.float64) for values in (grid.voxel_size, grid.origin))
    vertices = (mesh.vertices.detach() * mesh.unit_length - origin) / voxel
    found = torch.zeros(grid.shape)
    for first, slab in grid.slabs(MOST_VOXELS // 4):
        moved = vertices - torch.tensor([0.0, 0.0, first], dtype=torch.float64)
        found[first : first + slab.shape[0]] = surface_occupancy(moved, mesh.faces, slab.shape)
    return found
