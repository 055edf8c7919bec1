"""A small perceptron of space and time with smooth units: the velocity of a flow and its pressure, and derivatives.

With `h = tanh a` and subscripts for derivatives (chain rule; s₁ = 1 - h², s₂ = -2 h s₁, s₃ = (6 h² - 2) s₁):

    h_i = s₁ a_i,   h_ij = s₂ a_i a_j + s₁ a_ij,
    h_jkk = s₃ a_j a_k a_k + s₂ (a_j a_kk + 2 a_k a_jk) + s₁ a_jkk,   summed over the places k.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import pairwise
from typing import Annotated, Literal, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import embedding_bag, grid_sample

from holosplat.checks import require
from holosplat.ranges import MOST, Natural, Positive, Within, checked_dataclass

OUTPUTS = 4
"""Three of the velocity, or of its potential, and the pressure."""
FIRST_OUTPUT = 0.01
"""Size of the weights of the output at first: a flow that nearly stands still."""


class Jet(NamedTuple):
    """A function at P points. value: [P, …]; slope: [P, …, 3] by x, y, z; rate: [P, …] by the time; curved: [P, …] its
    Laplacian, or None where nobody asked for it."""

    value: Tensor
    slope: Tensor
    rate: Tensor
    curved: Tensor | None = None


class Taylor(NamedTuple):
    """H numbers at P points and their derivatives by `(x, y, z, t)`, as far as they were asked for. value: [P, H];
    first: [P, 4, H]; second: [P, 4, 4, H]; third: [P, 3, H], of the Laplacian by x, y, z."""

    value: Tensor
    first: Tensor
    second: Tensor | None = None
    third: Tensor | None = None

    def through(self, weight: Tensor, bias: Tensor) -> Taylor:
        """The same of `weight · h + bias`."""
        second, third = (None if part is None else part @ weight.T for part in (self.second, self.third))
        return Taylor(self.value @ weight.T + bias, self.first @ weight.T, second, third)

    def tanh(self) -> Taylor:
        """The same of the hyperbolic tangent."""
        a, h = self.first, torch.tanh(self.value)
        one = 1 - h**2
        two, first = -2 * h * one, one[:, None] * a
        if self.second is None:
            return Taylor(h, first)
        second = two[:, None, None] * (a[:, :, None] * a[:, None]) + one[:, None, None] * self.second
        if self.third is None:
            return Taylor(h, first, second)
        place, own = a[:, :3], self.second[:, :3, :3]
        flat = own.diagonal(dim1=1, dim2=2).sum(-1)[:, None]
        mixed = place * flat + 2 * (own * place[:, None]).sum(2)
        cubed = place * place.square().sum(1, keepdim=True)
        third = ((6 * h**2 - 2) * one)[:, None] * cubed + two[:, None] * mixed + one[:, None] * self.third
        return Taylor(h, first, second, third)


@checked_dataclass
class VelocityNetwork:
    """Options of the velocity."""

    solenoidal: bool = True
    """Whether the velocity is the curl of a potential, which has no divergence whatever the weights; else its three
    components are free."""
    hidden: Natural = 32
    """Units (tanh) of a hidden layer: flows of a channel are smooth."""
    layers: Natural = 2
    """Hidden layers."""

    def started(self, seed: int) -> dict[str, Tensor]:
        """Weights at first, after Glorot and Bengio (2010), float32: `weight0`, `bias0`, … of the layers."""
        generator = torch.Generator().manual_seed(seed)
        widths, found = [4, *[self.hidden] * self.layers, OUTPUTS], dict[str, Tensor]()
        for k, (a, b) in enumerate(pairwise(widths)):
            size = FIRST_OUTPUT if k == self.layers else 1.0
            found[f"weight{k}"] = size * math.sqrt(2 / (a + b)) * torch.randn(b, a, generator=generator)
            found[f"bias{k}"] = torch.zeros(b)
        return found

    def outputs(self, weights: Mapping[str, Tensor], at: Tensor, order: int) -> Taylor:
        """The four outputs at the points `at` [P, 4], and their derivatives up to `order`, 1 to 3."""
        first = torch.eye(4).to(at).expand(len(at), 4, 4)
        second = at.new_zeros(len(at), 4, 4, 4) if order > 1 else None
        found = Taylor(at, first, second, at.new_zeros(len(at), 3, 4) if order > 2 else None)
        for k in range(self.layers):
            found = found.through(weights[f"weight{k}"], weights[f"bias{k}"]).tanh()
        return found.through(weights[f"weight{self.layers}"], weights[f"bias{self.layers}"])

    def values(self, weights: Mapping[str, Tensor], at: Tensor) -> Tensor:
        """The velocity [P, 3] at the points `at` [P, 4]."""
        found = self.outputs(weights, at, 1)
        return _curl(found.first[:, :3, :3]) if self.solenoidal else found.value[:, :3]

    def jets(self, weights: Mapping[str, Tensor], at: Tensor, curved: bool = False) -> tuple[Jet, Jet]:
        """Velocity and pressure at the points `at` [P, 4]; curved: with the Laplacian of the velocity."""
        found = self.outputs(weights, at, 1 + curved + self.solenoidal)
        pressure = Jet(found.value[:, 3], found.first[:, :3, 3], found.first[:, 3, 3])
        second = found.second
        if not self.solenoidal:
            bent = second[:, :3, :3, :3].diagonal(dim1=1, dim2=2).sum(-1) if second is not None else None
            return Jet(found.value[:, :3], found.first[:, :3, :3].mT, found.first[:, 3, :3], bent), pressure
        assert second is not None
        slope = torch.stack([_curl(second[:, j, :3, :3]) for j in range(3)], -1)
        bent = _curl(found.third[..., :3]) if found.third is not None else None
        return Jet(_curl(found.first[:, :3, :3]), slope, _curl(second[:, 3, :3, :3]), bent), pressure


def _curl(slopes: Tensor) -> Tensor:
    """∇ × A [P, 3] of ∂A_c/∂x_j [P, j, c]."""
    x, y, z = slopes.unbind(1)
    return torch.stack([y[:, 2] - z[:, 1], z[:, 0] - x[:, 2], x[:, 1] - y[:, 0]], -1)


PRIMES = (1, 2_654_435_761, 805_459_861)
"""Multipliers of the spatial hash (Müller et al. 2022, eq. 4)."""
FIRST_FEATURES = 1e-4
"""Features start uniformly below this size, as Müller et al. (2022) have them."""


@checked_dataclass
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
    levels: Natural = 4
    features: Natural = 4
    coarsest: float = 16.0
    finest: float = 1.5
    log2_size: Annotated[int, Within(4, MOST)] = 17
    waves: Natural = 64
    bandwidth: Positive = 0.06

    def __post_init__(self) -> None:
        require(
            0 < self.finest <= self.coarsest,
            f"finest must lie between 0 and coarsest = {self.coarsest:g}, but it is {self.finest:g}.",
        )

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
