"""Position encodings of neural fields: features on grids of several resolutions, or random Fourier waves."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn.functional import embedding_bag, grid_sample

from ..checks import at_least, require
from ..ranges import Weight, ranged

PRIMES = (1, 2_654_435_761, 805_459_861)
"""Multipliers of the spatial hash (Müller et al. 2022, eq. 4)."""
FIRST_FEATURES = 1e-4
"""Features start uniformly below this size, as Müller et al. (2022) have them."""


@dataclass(frozen=True)
@ranged
class Encoding:
    """Options of an encoding.

    kind: `hash`, grids of features of several resolutions (Müller et al. 2022), stored in full where they fit into
    `2^log2_size` entries and hashed beyond; `fourier`, sines and cosines of random waves (Tancik et al. 2020); or
    `octaves`, of waves along the axes whose periods halve from the box's to no shorter ones than `finest` [pixels]
    (Mildenhall et al. 2020, eq. 4).
    hash: `levels` grids of `features` numbers a corner, from cells of `coarsest` to cells of `finest` [pixels];
    fourier: `waves` directions, their frequencies normally distributed with a standard deviation of `bandwidth`
    [cycles a pixel].
    """

    kind: Literal["hash", "fourier", "octaves"] = "hash"
    levels: int = 4
    features: int = 4
    coarsest: float = 16.0
    finest: float = 1.5
    log2_size: int = 17
    waves: int = 64
    bandwidth: Weight = 0.06

    def __post_init__(self) -> None:
        require(self.kind in ENCODINGS, f"kind must be one of {', '.join(ENCODINGS)}, but it is {self.kind!r}.")
        at_least(self, 1, "levels", "features", "waves")
        at_least(self, 4, "log2_size")
        require(
            0 < self.finest <= self.coarsest,
            f"finest must lie between 0 and coarsest = {self.coarsest:g}, but it is {self.finest:g}.",
        )
        require(self.bandwidth > 0, f"bandwidth must be positive, but it is {self.bandwidth:g}.")

    def build(self, extent: float, generator: torch.Generator) -> HashGrid | FourierWaves:
        """The encoding of positions in a box whose longest edge is `extent` [pixels]."""
        return ENCODINGS[self.kind](self, extent, generator)


class HashGrid(nn.Module):
    """Features [N, levels · features] at positions [N, 3] in pixels from the box's corner, linear within cells."""

    def __init__(self, options: Encoding, extent: float, generator: torch.Generator) -> None:
        super().__init__()
        self.width = options.levels * options.features
        growth = (options.coarsest / options.finest) ** (1 / max(1, options.levels - 1))
        self._cells = [options.coarsest / growth**level for level in range(options.levels)]
        self._corners = [math.ceil(extent / cell) + 2 for cell in self._cells]
        capacity = 2**options.log2_size
        shapes = [(n, n, n) if n**3 <= capacity else (capacity,) for n in self._corners]
        self.tables = nn.ParameterList(
            (2 * torch.rand(options.features, *shape, generator=generator) - 1) * FIRST_FEATURES for shape in shapes
        )

    def forward(self, positions: Tensor) -> Tensor:
        """The features of all levels, side by side."""
        levels = zip(self.tables, self._cells, self._corners)
        return torch.cat([_lookup(table, positions / cell, n) for table, cell, n in levels], dim=1)


def _lookup(table: Tensor, cells: Tensor, n: int) -> Tensor:
    """Features [N, F], linear between the corners around positions [N, 3] in cells.

    table: [F, n, n, n] along z, y, x, or [F, size] hashed."""
    if table.ndim == 4:
        points = (2 / (n - 1) * cells - 1)[None, None, None]
        return grid_sample(table[None], points, padding_mode="border", align_corners=True)[0, :, 0, 0].T
    index, weight = _hashed_corners(cells, table.shape[1])
    return embedding_bag(index, table.T.contiguous(), mode="sum", per_sample_weights=weight)


def _hashed_corners(cells: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """Entries [N, 8] of a hash table of `size`, and weights [N, 8], of the corners around positions [N, 3] in cells."""
    base = cells.floor()
    part, sides = cells - base, torch.arange(2, device=cells.device)
    x, y, z = ((base[:, a, None].long() + sides) * prime for a, prime in enumerate(PRIMES))
    wx, wy, wz = (torch.stack((1 - part[:, a], part[:, a]), dim=1) for a in range(3))
    index = (z[:, :, None, None] ^ y[:, None, :, None] ^ x[:, None, None, :]) % size
    weight = wz[:, :, None, None] * wy[:, None, :, None] * wx[:, None, None, :]
    return index.reshape(-1, 8), weight.reshape(-1, 8)


class FourierWaves(nn.Module):
    """Features [N, 2 · waves]: sines, cosines of 2πb·x (Tancik et al. 2020, eq. 5), at positions [N, 3] in pixels."""

    def __init__(self, options: Encoding, extent: float, generator: torch.Generator) -> None:
        super().__init__()
        waves = 2 * math.pi * self._frequencies(options, extent, generator)
        self.width = 2 * waves.shape[1]
        self.register_buffer("waves", waves)

    def _frequencies(self, options: Encoding, extent: float, generator: torch.Generator) -> Tensor:
        """b [3, waves] [cycles a pixel]."""
        return options.bandwidth * torch.randn(3, options.waves, generator=generator)

    def forward(self, positions: Tensor) -> Tensor:
        """The waves at the positions."""
        phases = positions @ self.get_buffer("waves")
        return torch.cat((phases.sin(), phases.cos()), dim=1)


class Octaves(FourierWaves):
    """The same of waves along each axis, whose frequencies double (Mildenhall et al. 2020, eq. 4)."""

    def _frequencies(self, options: Encoding, extent: float, generator: torch.Generator) -> Tensor:
        count = 1 + max(0, math.floor(math.log2(extent / options.finest)))
        return torch.cat([2.0**k / extent * torch.eye(3) for k in range(count)], dim=1)


ENCODINGS = {"hash": HashGrid, "fourier": FourierWaves, "octaves": Octaves}
"""Every encoding by its kind."""
