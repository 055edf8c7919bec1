"""Flow through a straight rectangular channel (Poiseuille's, in closed form), and contacts of bodies in it.

For half widths a ≤ b across the channel, with y and z measured from its axis (White 2006, Viscous Fluid Flow, eq. 3-48,
the parabola of the shorter side taken out of the series, so that the remainder falls off exponentially from the ends):

    u = G/2μ (a² - y² - 32 a²/π³ Σ (-1)^((n-1)/2)/n³ cos(nπy/2a) cosh(nπz/2a)/cosh(nπb/2a)),   n = 1, 3, 5 …

Repulsion where cells come close to each other or to a wall.
In a viscous fluid the film between two surfaces keeps them apart; nodes half a micrometre apart do not resolve it. A
short-ranged force between nodes takes its place: F (1 - r/d)²/(r/d)² below the distance d, smooth where it begins and
without bound at r = 0.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ...checks import in_range, require

TERMS = 40
"""Terms of the series: no slip holds to 1/(4 (2·40)²) = 4e-5 of the peak."""
SPEED_RANGE = (1e-9, 10.0)


@dataclass(frozen=True)
class Channel:
    """A channel along x with walls at y = 0, Ly and z = 0, Lz, periodic in x.

    box: (Lx, Ly, Lz) [m].
    peak: velocity on the axis [m/s].
    """

    box: tuple[float, float, float]
    peak: float

    def __post_init__(self) -> None:
        require(len(self.box) == 3, f"box must be three extents (x, y, z) in metres, but it is {self.box!r}.")
        for axis, extent in zip("xyz", self.box):
            in_range(f"box extent {axis}", extent, 1e-9, 1.0, unit="metres")
        in_range("peak velocity", self.peak, *SPEED_RANGE, unit="metres a second")

    @property
    def halves(self) -> tuple[float, float]:
        """Half the shorter and half the longer side across the flow [m]."""
        return 0.5 * min(self.box[1:]), 0.5 * max(self.box[1:])

    def speed(self, points: Tensor) -> Tensor:
        """Velocity along x [...] [m/s] at `points` [..., 3] [m]; 0 in the walls."""
        profile = self._profile(points)
        middle = self._profile(points.new_tensor([0.0, 0.5 * self.box[1], 0.5 * self.box[2]]))
        return self.peak * profile / middle

    def velocity(self, points: Tensor) -> Tensor:
        """Velocity [..., 3] [m/s] at `points` [..., 3] [m]."""
        speed = self.speed(points)
        return torch.stack([speed, torch.zeros_like(speed), torch.zeros_like(speed)], dim=-1)

    def pressure_gradient(self, viscosity: float) -> float:
        """G = -dp/dx [Pa/m] that drives it, for a viscosity [Pa s]."""
        middle = torch.tensor([0.0, 0.5 * self.box[1], 0.5 * self.box[2]], dtype=torch.float64)
        a, _ = self.halves
        return 2 * viscosity * self.peak / (a**2 * float(self._profile(middle)))

    def flow_rate(self) -> float:
        """Volume a second [m³/s]: 4ba³G/3μ (1 - 192a/(π⁵b) Σ tanh(nπb/2a)/n⁵) (White 2006, eq. 3-48)."""
        a, b = self.halves
        odd = range(1, 2 * TERMS, 2)
        series = sum(math.tanh(n * math.pi * b / (2 * a)) / n**5 for n in odd)
        return 4 / 3 * b * a**3 * self.pressure_gradient(1.0) * (1 - 192 * a / (math.pi**5 * b) * series)

    def mean_speed(self) -> float:
        """Flow rate over cross-section [m/s]."""
        return self.flow_rate() / (self.box[1] * self.box[2])

    def shear_rate(self) -> float:
        """Greatest shear rate of a plane channel as wide as the shorter side, 2 peak/a [1/s]."""
        return 2 * self.peak / self.halves[0]

    def depth(self, points: Tensor) -> Tensor:
        """Distance [..., 4] [m] from the walls y = 0, y = Ly, z = 0, z = Lz, negative behind them."""
        y, z = points[..., 1], points[..., 2]
        return torch.stack([y, self.box[1] - y, z, self.box[2] - z], dim=-1)

    def folded(self, nodes: Tensor) -> Tensor:
        """Cells [C, P, 3] moved by whole periods such that their centres lie in 0 ≤ x < Lx."""
        turns = torch.floor(nodes[..., 0].mean(-1) / self.box[0])
        return nodes - turns[:, None, None] * nodes.new_tensor([self.box[0], 0.0, 0.0])

    def _profile(self, points: Tensor) -> Tensor:
        """2μu/(Ga²) [...], from the formula above; y is the shorter side's coordinate."""
        a, b = self.halves
        short, long = (1, 2) if self.box[1] <= self.box[2] else (2, 1)
        y = (points[..., short] - a) / a
        z = ((points[..., long] - b) / a).abs()
        n = torch.arange(1, 2 * TERMS, 2, dtype=points.dtype, device=points.device)
        k = 0.5 * math.pi * n
        sign = 1 - 2 * (torch.arange(TERMS, dtype=points.dtype, device=points.device) % 2)
        decay = torch.exp(k * (z.clamp(max=b / a).unsqueeze(-1) - b / a))
        decay = decay * (1 + torch.exp(-2 * k * z.unsqueeze(-1))) / (1 + torch.exp(-2 * k * b / a))
        series = (sign / n**3 * torch.cos(k * y.unsqueeze(-1)) * decay).sum(-1)
        profile = 1 - y**2 - 32 / math.pi**3 * series
        return torch.where((y.abs() < 1) & (z < b / a), profile, torch.zeros_like(profile))


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
    first, second, shift = _near_pairs(nodes, channel, repulsion.range_)
    flat = nodes.reshape(-1, 3)
    apart = flat[first] - flat[second] - shift
    distance = apart.norm(dim=-1, keepdim=True)
    push = repulsion.force(distance) * apart / distance.clamp(min=CLOSEST * repulsion.range_)
    total = torch.zeros_like(flat).index_add(0, first, push).index_add(0, second, -push)
    return total.reshape(nodes.shape)


def _near_pairs(nodes: Tensor, channel: Channel, reach: float) -> tuple[Tensor, Tensor, Tensor]:
    """Numbers [N], [N] of nodes of different cells closer than `reach`, each pair once, and how far the second one's
    image is shifted [N, 3] [m]."""
    nodes = nodes.detach()
    cells, size, _ = nodes.shape
    centres = nodes.mean(1)
    local = nodes - centres[:, None]
    radius = local.norm(dim=-1).amax(1)
    one, other = torch.triu_indices(cells, cells, 1, device=nodes.device)
    found = []
    for turn in (-1.0, 0.0, 1.0):
        way = centres[other] - centres[one]
        period = way.new_tensor([channel.box[0], 0.0, 0.0])
        shift = (turn - torch.round(way[:, :1] / channel.box[0])) * period
        near = torch.nonzero((way + shift).norm(dim=-1) < radius[one] + radius[other] + reach)[:, 0]
        for k in near.split(max(1, pairs_at_a_time(nodes.device) // size**2)):
            i, j = one[k], other[k]
            # Differences of coordinates about one centre keep their digits in the squares of `cdist`.
            apart = torch.cdist(local[i], local[j] + (way + shift)[k][:, None])
            pair, p, q = torch.nonzero(apart < reach, as_tuple=True)
            found.append((i[pair] * size + p, j[pair] * size + q, shift[k][pair]))
    if not found:
        none = torch.zeros(0, dtype=torch.long, device=nodes.device)
        return none, none, nodes.new_zeros(0, 3)
    first, second, shift = (torch.cat(part) for part in zip(*found))
    return first, second, shift


def pairs_at_a_time(device: torch.device) -> int:
    """Pairs of nodes in one array: what a processor's cache holds, or what keeps a GPU busy."""
    return 1 << (17 if device.type == "cpu" else 25)
