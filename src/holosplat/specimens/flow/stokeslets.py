"""The flow of a viscous fluid under point forces: regularised Stokeslets, summed without a matrix.

A force f spread over a blob of size ε moves the fluid at distance r by (Cortez, Fauci & Medovikov 2005, Phys. Fluids
17, 031504, after Cortez 2001, SIAM J. Sci. Comput. 23, 1204)

    u = 1/(8πμ) [f (r² + 2ε²) + (f·r) r]/(r² + ε²)^(3/2),

which is free of divergence everywhere, and finite at r = 0.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

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
    """8πμ times the velocities that two sets of nodes [P, 3], [Q, 3] and their `forces` give each other.

    One pass over the pairs serves both ways.
    """
    square = _squares(first, second, blob)
    cube = square.rsqrt() / square
    even = torch.addcmul(cube * square, cube, square.new_tensor(blob**2))
    f, g = forces
    along = cube * (first @ g.T - (second * g).sum(-1))
    on_first = even @ g + first * along.sum(1, keepdim=True) - along @ second
    along = cube * (f @ second.T - (first * f).sum(-1, keepdim=True))
    on_second = even.T @ f + second * along.sum(0)[:, None] - along.T @ first
    return on_first, on_second


def _one_way(targets: Tensor, sources: Tensor, forces: Tensor, blob: float) -> Tensor:
    """8πμ times the velocity [T, 3]."""
    square = _squares(targets, sources, blob)
    cube = square.rsqrt() / square
    along = cube * (targets @ forces.T - (sources * forces).sum(-1))
    even = torch.addcmul(cube * square, cube, square.new_tensor(blob**2))
    return even @ forces + targets * along.sum(1, keepdim=True) - along @ sources


def _squares(targets: Tensor, sources: Tensor, blob: float) -> Tensor:
    """r² + ε² [T, S]."""
    offsets = (targets**2).sum(-1, keepdim=True) + (sources**2).sum(-1) + blob**2
    return torch.addmm(offsets, targets, sources.T, alpha=-2).clamp_min_(blob**2)
