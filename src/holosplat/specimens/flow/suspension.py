"""Cells in a channel: how fast each node moves, given where all are, and their motion over time.

Flow through a straight rectangular channel (Poiseuille's, in closed form), and contacts of bodies in it.

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
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from ...checks import InputError, in_range, require
from ...ranges import Positive, checked_dataclass
from ..membrane.model import Membrane

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


BLOB = 0.39
"""ε in square roots of a node's area, at which a ball of evenly spaced nodes drags as Stokes says (tests)."""


def mutual_velocity(first: Tensor, second: Tensor, forces: tuple[Tensor, Tensor], blob: float) -> tuple[Tensor, Tensor]:
    """8πμ times the velocities that two sets of nodes [..., P, 3], [..., Q, 3] and their `forces` give each other.

    One pass over the pairs serves both ways.
    """
    square = _squares(first, second, blob)
    cube = square.rsqrt() / square
    even = torch.addcmul(cube * square, cube, square.new_tensor(blob**2))
    f, g = forces
    along = cube * (first @ g.mT - (second * g).sum(-1).unsqueeze(-2))
    on_first = even @ g + first * along.sum(-1, keepdim=True) - along @ second
    along = cube * (f @ second.mT - (first * f).sum(-1, keepdim=True))
    on_second = even.mT @ f + second * along.sum(-2).unsqueeze(-1) - along.mT @ first
    return on_first, on_second


def one_way_velocity(targets: Tensor, sources: Tensor, forces: Tensor, blob: float) -> Tensor:
    """8πμ times the velocity [..., T, 3] at `targets` of the `forces` [..., S, 3] [N] at `sources`; blob: ε [m]."""
    square = _squares(targets, sources, blob)
    cube = square.rsqrt() / square
    along = cube * (targets @ forces.mT - (sources * forces).sum(-1).unsqueeze(-2))
    even = torch.addcmul(cube * square, cube, square.new_tensor(blob**2))
    return even @ forces + targets * along.sum(-1, keepdim=True) - along @ sources


def _squares(targets: Tensor, sources: Tensor, blob: float) -> Tensor:
    """r² + ε² [..., T, S]."""
    offsets = (targets**2).sum(-1, keepdim=True) + (sources**2).sum(-1).unsqueeze(-2) + blob**2
    product = torch.addmm if targets.dim() == 2 else torch.baddbmm
    return product(offsets, targets, sources.mT, alpha=-2).clamp_min_(blob**2)


PLASMA_VISCOSITY = 1.2e-3
"""Of blood plasma at 37 °C [Pa s] (Késmárky et al. 2008, Clin. Hemorheol. Microcirc. 39, 243)."""


@checked_dataclass
class Medium:
    """The fluid, the same inside and outside the cells, and the short-ranged force in place of its thin films."""

    viscosity: Positive = PLASMA_VISCOSITY
    """[Pa s]."""
    reach: float | None = None
    """Cells whose centres are farther apart do not feel each other's flow [m] (default: the channel's shorter side, but
    at most half its length)."""
    repulsion: float = 2e-11
    """Force between nodes of different cells, or of a node and a wall, at half the range [N]."""
    repulsion_range: float | None = None
    """Distance at which it begins [m] (default: the mean edge of the mesh)."""

    def check(self) -> None:
        """`InputError` for numbers that cannot be."""
        in_range("viscosity", self.viscosity, 1e-6, 1e3, unit="pascal seconds")
        for name in ("reach", "repulsion_range"):
            if getattr(self, name) is not None:
                in_range(name.replace("_", " "), getattr(self, name), 1e-10, 1.0, unit="metres")


class Suspension:
    """Cells of one rest shape in a channel.

    A node moves with the fluid: with the undisturbed flow and the flow that the forces of all membranes cause. With one
    viscosity inside and outside, this is the complete Stokes flow except for the walls, which do not reflect the cells'
    flow here. Between walls the flow around a force-free cell falls off exponentially, so it ends at `reach` (fading
    from half of it on); in free space it would fall off as 1/r².
    """

    def __init__(self, membrane: Membrane, channel: Channel, medium: Medium = Medium()) -> None:
        medium.check()
        self.membrane, self.channel, self.medium = membrane, channel, medium
        spacing = math.sqrt(float(membrane.rest.surface) / len(membrane.mesh.vertices))
        self.blob = BLOB * spacing
        edge = float(membrane.rest.length.mean())
        self.repulsion = Repulsion(medium.repulsion, medium.repulsion_range or edge)
        half = 0.5 * channel.box[0]
        self.reach = min(*channel.box[1:], half) if medium.reach is None else medium.reach
        require(
            0 < self.reach <= half,
            f"reach must lie between 0 and half the channel's length, {half:.4g} m, but it is {self.reach:.4g} m.",
        )

    def forces(self, nodes: Tensor) -> Tensor:
        """Forces [C, P, 3] [N] on nodes [C, P, 3] [m]: elastic ones, of walls, and between cells."""
        elastic = self.membrane.forces(nodes)
        return (
            elastic
            + wall_forces(nodes, self.channel, self.repulsion)
            + contact_forces(nodes, self.channel, self.repulsion)
        )

    def velocity(self, nodes: Tensor) -> Tensor:
        """Velocity [C, P, 3] [m/s] of nodes [C, P, 3] [m]."""
        return self.channel.velocity(nodes) + self.disturbance(nodes, self.forces(nodes))

    def disturbance(self, nodes: Tensor, forces: Tensor) -> Tensor:
        """Velocity [C, P, 3] [m/s] of nodes [C, P, 3] [m] in the flow that `forces` [C, P, 3] [N] on them cause."""
        centres = nodes.mean(1)
        local = nodes - centres[:, None]  # small numbers, whose squares keep their digits
        some = max(1, pairs_at_a_time(nodes.device) // nodes.shape[1] ** 2)
        parts = zip(local.split(some), forces.split(some))
        total = torch.cat([one_way_velocity(x, x, f, self.blob) for x, f in parts])
        one, other, way, weight = self._neighbours(centres)
        for k in torch.arange(len(one), device=nodes.device).split(some):
            i, j = one[k], other[k]
            on_i, on_j = mutual_velocity(local[i], local[j] + way[k, None], (forces[i], forces[j]), self.blob)
            faded = weight[k, None, None]
            total = total.index_add(0, i, faded * on_i).index_add(0, j, faded * on_j)
        return total / (8 * math.pi * self.medium.viscosity)

    def _neighbours(self, centres: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Pairs of cells within reach: their numbers [M], the ways [M, 3] from first to second, the weights [M]."""
        first, second = torch.triu_indices(len(centres), len(centres), 1, device=centres.device)
        way = centres[second] - centres[first]
        period = self.channel.box[0]
        way = torch.cat([way[:, :1] - period * torch.round(way[:, :1] / period), way[:, 1:]], dim=1)
        s = (2 - 2 * (way.norm(dim=-1) / self.reach)).clamp(0, 1)  # 1 up to half the reach, 0 from it on
        weight = s**3 * (10 - 15 * s + 6 * s**2)
        near = torch.nonzero(weight > 0)[:, 0]
        return first[near], second[near], way[near], weight[near]


SAFETY, SHRINK, GROW = 0.9, 0.2, 3.0
SMALLEST = 1e-6
"""A step shorter than this fraction of the time to cover is taken for a failure."""

Check = Callable[[Tensor, float], None]


@dataclass(frozen=True)
class State:
    """Nodes [C, P, 3] [m] at `time` [s], the next step to try [s], and how many steps were taken and refused."""

    nodes: Tensor
    time: float
    step: float
    taken: int = 0
    refused: int = 0


class Stepper:
    """The method of Bogacki & Shampine (1989, Appl. Math. Lett. 2, 321), third order, with steps of chosen length.

    Each step is also made to second order; the greatest distance between both results over all nodes is the estimate of
    its error. A step is kept where that is below the tolerance, and the next one is as long as the tolerance allows
    (with a margin). Steps that are too long for the stiffness of the membranes amplify the error, and so are refused
    by the same rule: it also keeps the method stable.
    """

    def __init__(self, velocity: Callable[[Tensor], Tensor], tolerance: float) -> None:
        self.velocity, self.tolerance = velocity, tolerance

    def advance(self, state: State, until: float, check: Check = lambda nodes, time: None) -> State:
        """`state` at the time `until` [s]; `check` is called with nodes and time after every step.

        `InputError` where steps vanish.
        """
        require(until >= state.time, f"the time to reach must lie ahead, but {until} s is before {state.time} s.")
        nodes, time, step, taken, refused = state.nodes, state.time, state.step, state.taken, state.refused
        shortest = SMALLEST * (until - time)
        slope = self.velocity(nodes) if until > time else nodes
        while time < until:
            last = time + 1.0000001 * step >= until  # no crumb is left over
            trial = until - time if last else step
            moved, next_slope, error = self._step(nodes, slope, trial)
            factor = SAFETY * (self.tolerance / max(error, 1e-3 * self.tolerance)) ** (1 / 3)
            if error <= self.tolerance:
                nodes, slope, time, taken = moved, next_slope, until if last else time + trial, taken + 1
                step = max(step, trial * min(GROW, factor)) if last else trial * min(GROW, factor)
            else:  # NaN too
                step = trial * (max(SHRINK, factor) if error < float("inf") else SHRINK)
                refused += 1
                if not step > shortest:
                    raise InputError(
                        f"the motion must be smooth, but at {time:.6g} s steps became shorter than {step:.3g} s: the "
                        "membranes or contacts are too stiff, or the flow too fast; lower one of them."
                    )
            check(nodes, time)
        return State(nodes, time, step, taken, refused)

    def _step(self, nodes: Tensor, slope: Tensor, step: float) -> tuple[Tensor, Tensor, float]:
        """Nodes after `step`, the velocity there, and the estimated error [m]."""
        second = self.velocity(nodes + 0.5 * step * slope)
        third = self.velocity(nodes + 0.75 * step * second)
        moved = nodes + step * (2 / 9 * slope + 1 / 3 * second + 4 / 9 * third)
        last = self.velocity(moved)
        error = step * (-5 / 72 * slope + 1 / 12 * second + 1 / 9 * third - 1 / 8 * last)
        worst = float(error.norm(dim=-1).max())
        return moved, last, worst if torch.isfinite(error).all() else float("inf")
