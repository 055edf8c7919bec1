"""Gaussians of several sizes that fill a volume: small ones where it changes, large ones where it does not."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool3d, max_pool3d, pad

from ..checks import require
from ..geometry import Grid
from ..matter import Matter
from .gaussians import GaussianCloud, raw_of
from .initialise import CALM, FILLED, SMALLEST


def cloud_in_octree(
    occupancy: Tensor,
    grid: Grid,
    material: tuple[float, float],
    unit_length: float,
    sizes: int,
    edge: int = 1,
    filled: float = FILLED,
) -> GaussianCloud:
    """A cloud of one material that approximates `occupancy` [Z, Y, X] on `grid`, one Gaussian a filled block.

    Blocks have edges of `edge` voxels, and of twice that, and so on, `sizes` of them. A larger block is taken where
    occupancies in it and in all blocks of its size around it differ by less than `CALM` of its own. Each becomes an
    isotropic Gaussian of its mass with half its edge as standard deviation, as in `cloud_from_volume`. filled: share of
    matter from which on a block is taken. unit_length [m]: the cloud's unit. Errors: `InputError` where all is empty.
    """
    whole = edge * 2 ** (sizes - 1)
    missing = [(-n) % whole for n in occupancy.shape]
    volume = occupancy.float()
    if any(missing):  # a large volume is not copied in vain
        volume = pad(volume, (0, missing[2], 0, missing[1], 0, missing[0]))
    levels = _levels(volume.clamp_min(0) if float(volume.min()) < 0 else volume, sizes, edge)
    mass, corner, size = (torch.cat(parts) for parts in zip(*_chosen(levels, filled, edge)))
    require(len(mass) > 0, "there is no matter in the volume to make Gaussians of.")
    voxel = grid.voxel_size[0]
    centre = (corner + 0.5 * (size[:, None] - 1)) * voxel + torch.tensor(grid.origin, dtype=torch.float32)
    sigma = 0.5 * size * voxel
    peak = mass * (size * voxel / sigma) ** 3 / (2 * np.pi) ** 1.5
    log_scales = torch.log(sigma / unit_length)[:, None].repeat(1, 3)
    turned = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(len(mass), 1)
    raw = raw_of(peak.clamp_min(SMALLEST))[:, None]
    return GaussianCloud((centre / unit_length, log_scales, turned, raw), unit_length, Matter.one(*material))


Level = tuple[Tensor, Tensor, Tensor]
"""Mean, largest and smallest occupancy [z, y, x] of blocks of one size."""


def _levels(volume: Tensor, sizes: int, edge: int) -> list[Level]:
    """Blocks of each size, the smallest first."""
    found = [tuple(_pooled(volume, edge, how) for how in ("mean", "max", "min"))]
    for _ in range(sizes - 1):
        mean, most, least = found[-1]
        found.append((_pooled(mean, 2, "mean"), _pooled(most, 2, "max"), _pooled(least, 2, "min")))
    return [(mean, most, least) for mean, most, least in found]


def _pooled(values: Tensor, edge: int, how: str) -> Tensor:
    if edge == 1:
        return values
    if how == "mean":
        return avg_pool3d(values[None], edge)[0]
    sign = 1 if how == "max" else -1
    return sign * max_pool3d(sign * values[None], edge)[0]


def _chosen(levels: list[Level], filled: float, edge: int) -> list[tuple[Tensor, Tensor, Tensor]]:
    """Of each size, the largest first: mean [N], first voxel [N, 3] as (x, y, z) and edge [N] of the blocks taken."""
    taken, found = torch.zeros_like(levels[-1][0], dtype=torch.bool), list[tuple[Tensor, Tensor, Tensor]]()
    for number in range(len(levels) - 1, -1, -1):
        mean, most, least = levels[number]
        here = (mean > filled) & ~taken
        if number > 0:
            change = max_pool3d(most[None], 3, 1, 1)[0] + max_pool3d(-least[None], 3, 1, 1)[0]
            here &= change <= CALM * mean
        size = edge * 2**number
        corner = here.nonzero().flip(1).float() * size
        found.append((mean[here], corner, torch.full((len(corner),), float(size))))
        if number > 0:
            taken = taken | here
            for axis in range(3):
                taken = taken.repeat_interleave(2, axis)
    return found
