"""Cells in a channel: how fast each node moves, given where all are, and their motion over time."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from ...checks import InputError, in_range, require
from ...ranges import Positive, checked_dataclass
from ..membrane.model import Membrane
from .channel import Channel, Repulsion, contact_forces, pairs_at_a_time, wall_forces

BLOB = 0.39
"""ε in square roots of a node's area, at which a ball of evenly spaced nodes drags as Stokes says (tests)."""
CHUNK = 512
"""Targets handled at a time by `stokeslet_velocity`: rows that stay in the processor's cache."""


def stokeslet_velocity(targets: Tensor, sources: Tensor, forces: Tensor, blob: float, viscosity: float) -> Tensor:
    """Velocity [T, 3] [m/s] at `targets` [T, 3] of the `forces` [S, 3] [N] at `sources` [S, 3] [m].

    blob: ε [m]; viscosity [Pa s].
    """
    found = [_one_way(part, sources, forces, blob) for part in targets.split(CHUNK)]
    return torch.cat(found) / (8 * math.pi * viscosity)


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


def _one_way(targets: Tensor, sources: Tensor, forces: Tensor, blob: float) -> Tensor:
    """8πμ times the velocity [..., T, 3]."""
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
        total = torch.cat([_one_way(x, x, f, self.blob) for x, f in parts])
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
        weight = _fading(way.norm(dim=-1) / self.reach)
        near = torch.nonzero(weight > 0)[:, 0]
        return first[near], second[near], way[near], weight[near]


def _fading(ratio: Tensor) -> Tensor:
    """1 up to a half, 0 from 1 on, smooth in between."""
    s = (2 - 2 * ratio).clamp(0, 1)
    return s**3 * (10 - 15 * s + 6 * s**2)


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
