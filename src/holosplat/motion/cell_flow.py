"""Cells in a channel as a differentiable model of motion: where membranes are later, given where they are now.

The physics is that of `specimens/flow`: every node moves with the fluid, Stokes' flow without inertia, one viscosity
inside and outside, the channel's undisturbed flow and regularised Stokeslets of all membrane forces; no answer of the
walls to these. What is unknown of it are a few numbers (`Unknowns`), and all steps can be differentiated by them and by
the first state: the time steps are even, and each is computed again on the way back, so that memory is that of one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from ..specimens.flow.channel import Channel
from ..specimens.flow.contacts import contact_forces, wall_forces
from ..specimens.flow.suspension import Medium, Suspension
from ..specimens.membrane.model import Elasticity, Membrane

Velocity = Callable[[Tensor], Tensor]


@dataclass(frozen=True)
class Unknowns:
    """Numbers of the flow, float64 tensors that may ask for gradients.

    peak: of the undisturbed flow, on the axis [] [m/s]; shear: Skalak's modulus G [] [N/m]. With one viscosity
    everywhere motion tells G over the viscosity alone.
    """

    peak: Tensor
    shear: Tensor

    @classmethod
    def of(cls, peak: float, shear: float) -> Unknowns:
        """From plain numbers."""
        return cls(*(torch.tensor(value, dtype=torch.float64) for value in (peak, shear)))


class CellFlow:
    """Cells of one rest shape, each with its own volume and area, in a channel (its frame: x along the flow)."""

    def __init__(self, membrane: Membrane, nodes: Tensor, channel: Channel, medium: Medium) -> None:
        """nodes [C, P, 3] [m]: the cells as they are; their areas and volumes are the ones that they keep.

        membrane: whose shear modulus is left to `Unknowns`; channel: of which the peak is.
        """
        self.channel = replace(channel, peak=1.0)
        of = membrane.elasticity
        self._sheared = Membrane(
            membrane.mesh, Elasticity(1.0, of.skalak_dilation, bending=0.0, global_area=0.0, volume=0.0)
        )
        self._other = Membrane(membrane.mesh, replace(of, skalak_shear=0.0))
        kept = nodes.detach()
        areas, volumes = membrane.surface(kept), membrane.volume(kept)
        self._other.rest = replace(self._other.rest, surface=areas[:, None], volume=volumes)
        self._suspension = Suspension(membrane, self.channel, medium)

    def forces(self, nodes: Tensor, unknowns: Unknowns) -> Tensor:
        """[C, P, 3] [N] on nodes [C, P, 3] [m]."""
        repulsion = self._suspension.repulsion
        elastic = unknowns.shear * self._sheared.forces(nodes) + self._other.forces(nodes)
        return elastic + wall_forces(nodes, self.channel, repulsion) + contact_forces(nodes, self.channel, repulsion)

    def velocity(self, nodes: Tensor, unknowns: Unknowns) -> Tensor:
        """[C, P, 3] [m/s] of nodes [C, P, 3] [m]."""
        carried = unknowns.peak * self.channel.velocity(nodes)
        return carried + self._suspension.disturbance(nodes, self.forces(nodes, unknowns))


def advanced(velocity: Velocity, nodes: Tensor, duration: float, step: float) -> Tensor:
    """`nodes` [..., 3] [m] after `duration` [s], in even steps of at most `step` [s].

    Runge and Kutta's method of fourth order. Gradients flow through all steps; each is computed again for them.
    """
    count = max(1, round(duration / step + 0.499999))
    for _ in range(count):
        args = velocity, nodes, duration / count
        recomputed = torch.is_grad_enabled()
        nodes = checkpoint(_step, *args, use_reentrant=False) if recomputed else _step(*args)
    return nodes


def _step(velocity: Velocity, nodes: Tensor, step: float) -> Tensor:
    first = velocity(nodes)
    second = velocity(nodes + 0.5 * step * first)
    third = velocity(nodes + 0.5 * step * second)
    fourth = velocity(nodes + step * third)
    return nodes + step / 6 * (first + 2 * second + 2 * third + fourth)
