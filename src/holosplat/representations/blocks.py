"""A volume in blocks, of which only those with matter in them or near are looked at."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import max_pool3d

from ..geometry import Grid
from .gaussians import GaussianCloud

MARGIN = 8
"""Voxels around matter that are looked at, too: four standard deviations of Gaussians that fill blocks of four."""
CUTOFF, GROWTH, SLACK = 4.0, 1.2, 1.0
"""Standard deviations that a Gaussian reaches; by which factor, and by how many voxels more, it may grow and move until
its blocks are looked up again."""


@dataclass(frozen=True)
class Block:
    """Part of a volume. grid: its voxels; values: [..., z, y, x] on them."""

    grid: Grid
    values: Tensor

    def near(self, cloud: GaussianCloud) -> Tensor:
        """Which Gaussians of `cloud` reach into the block, or may soon, by their numbers."""
        voxel = self.grid.voxel_size[0]
        with torch.no_grad():
            scale = cloud.unit_length / voxel
            sigma = (cloud.scales.amax(dim=1) * scale).square().add(1 / 12).sqrt()  # a voxel's own variance
            reach = (GROWTH * CUTOFF * sigma + SLACK)[:, None]
            middle = torch.as_tensor(self.grid.centre / voxel, dtype=torch.float32)
            half = 0.5 * torch.tensor(self.grid.shape[::-1], dtype=torch.float32)
            return ((cloud.centres * scale - middle).abs() <= half + reach).all(dim=1).nonzero()[:, 0]


def filled_blocks(values: Tensor, grid: Grid, edge: int) -> Iterator[Block]:
    """The blocks of `edge`³ voxels (the last ones are smaller) that have matter within `MARGIN` voxels.

    values: [..., Z, Y, X] on `grid`; the blocks are views of it.
    """
    most = values.detach().reshape(1, -1, *grid.shape).amax(dim=1)
    there = max_pool3d(most, edge + 2 * MARGIN, edge, MARGIN, ceil_mode=True)[0] > 0
    for corner in there.nonzero().tolist():
        z, y, x = (edge * k for k in corner)
        if not (z < grid.shape[0] and y < grid.shape[1] and x < grid.shape[2]):
            continue  # beyond the grid, where pooling has looked at its last voxels once more
        part = values[..., z : z + edge, y : y + edge, x : x + edge]
        depth, height, width = part.shape[-3:]
        yield Block(grid.block((z, y, x), (depth, height, width)), part)
