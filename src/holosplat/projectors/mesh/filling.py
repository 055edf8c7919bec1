"""How much of each voxel closed meshes fill, by the hits of rays along z; plain torch, float64."""

from __future__ import annotations

import torch
from torch import Tensor

from ...geometry import Grid
from .reference import NUDGE, ray_hits


def occupancy(vertices: Tensor, faces: Tensor, values: Tensor, grid: Grid, rays: int) -> Tensor:
    """[C, Z, Y, X] float64 values averaged over voxels (rays along z; exact overlap of each depth interval)."""
    nz, ny, nx = grid.shape
    position = (vertices - vertices.new_tensor(grid.origin)) / vertices.new_tensor(grid.voxel_size)
    position[:, :2] = rays * (position[:, :2] + 0.5) - 0.5 + vertices.new_tensor(NUDGE)
    position[:, 2] += 0.5  # now voxel k spans [k, k + 1]
    # A surface at depth z fills every voxel below it: deposit its part at voxel k = ⌊z⌋, the rest at k - 1,
    # and sum downwards. Slot 0 collects what lies below the grid.
    out = values.new_zeros(len(values), (nz + 1) * ny * nx)
    for ray, z, sign, face in ray_hits(position, faces, (rays * ny, rays * nx)):
        depth = z.clamp(0, nz)
        k = depth.long().clamp_max(nz - 1)
        row, column = ray // (rays * nx), ray % (rays * nx)
        slot = k * ny * nx + (row // rays) * nx + column // rays
        for total, value in zip(out, values):
            weight = sign * value[face]
            total += torch.bincount(slot + ny * nx, weight * (depth - k), out.shape[1])
            total += torch.bincount(slot, weight * (1 - depth + k), out.shape[1])
    filled = out.reshape(-1, nz + 1, ny, nx).flip(1).cumsum(1).flip(1)
    filled[filled.abs() < 1e-12 * values.abs().max()] = 0  # what the sums leave of a zero
    return filled[:, 1:] / rays**2
