"""Repulsion where cells come close to each other or to a wall.

In a viscous fluid the film between two surfaces keeps them apart; nodes half a micrometre apart do not resolve it. A
short-ranged force between nodes takes its place: F (1 - r/d)²/(r/d)² below the distance d, smooth where it begins and
without bound at r = 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import KDTree
from torch import Tensor

from ...checks import in_range
from .channel import Channel

CLOSEST = 0.05
"""Closer than this, in ranges, the force stays as it is (a node behind the wall is pushed back by it)."""


@dataclass(frozen=True)
class Repulsion:
    """strength: F [N], the force at r = d/2; range_: d [m]."""

    strength: float
    range_: float

    def __post_init__(self) -> None:
        in_range("repulsion strength", self.strength, 1e-18, 1e-6, unit="newtons")
        in_range("repulsion range", self.range_, 1e-10, 1e-3, unit="metres")

    def force(self, distance: Tensor) -> Tensor:
        """[N] at `distance` [m], pushing apart."""
        ratio = (distance / self.range_).clamp(CLOSEST, 1.0)
        return self.strength * ((1 - ratio) / ratio) ** 2

    def energy(self, distance: Tensor) -> Tensor:
        """[J]: F d (1/s + 2 ln s - s), s = r/d, continued straight on below the closest distance."""
        ratio = (distance / self.range_).clamp(CLOSEST, 1.0)
        energy = self.strength * self.range_ * (1 / ratio + 2 * torch.log(ratio) - ratio)
        return energy + self.force(distance) * (CLOSEST * self.range_ - distance).clamp(min=0)


def wall_forces(nodes: Tensor, channel: Channel, repulsion: Repulsion) -> Tensor:
    """Forces [..., 3] [N] of the four walls on `nodes` [..., 3] [m]."""
    low_y, high_y, low_z, high_z = repulsion.force(channel.depth(nodes)).unbind(-1)
    return torch.stack([torch.zeros_like(low_y), low_y - high_y, low_z - high_z], dim=-1)


def contact_forces(nodes: Tensor, channel: Channel, repulsion: Repulsion) -> Tensor:
    """Forces [C, P, 3] [N] between nodes [C, P, 3] [m] of different cells, across the channel's periodic ends too."""
    first, second = _near_pairs(nodes, channel, repulsion.range_)
    flat = nodes.reshape(-1, 3)
    apart = flat[first] - flat[second]
    period = channel.box[0]
    along = apart[:, 0] - period * torch.round(apart[:, 0] / period)
    apart = torch.cat([along[:, None], apart[:, 1:]], dim=1)
    distance = apart.norm(dim=-1, keepdim=True)
    push = repulsion.force(distance) * apart / distance.clamp(min=CLOSEST * repulsion.range_)
    total = torch.zeros_like(flat).index_add(0, first, push).index_add(0, second, -push)
    return total.reshape(nodes.shape)


def _near_pairs(nodes: Tensor, channel: Channel, reach: float) -> tuple[Tensor, Tensor]:
    """Numbers of nodes of different cells closer than `reach`, each pair once."""
    points = nodes.detach().reshape(-1, 3).numpy().copy()
    period = channel.box[0]
    points[:, 0] = np.mod(points[:, 0], period)
    points[points[:, 0] >= period, 0] = 0.0  # the rest of a tiny negative number is the period itself
    tree = KDTree(points, boxsize=[period, 0, 0])
    pairs = tree.query_pairs(reach, output_type="ndarray").astype(np.int64)
    cell = pairs // nodes.shape[1]
    pairs = pairs[cell[:, 0] != cell[:, 1]]
    return torch.from_numpy(pairs[:, 0].copy()), torch.from_numpy(pairs[:, 1].copy())
