"""A small perceptron of space and time with smooth units: the velocity of a flow and its pressure, and derivatives.

With `h = tanh a` and subscripts for derivatives (chain rule; s₁ = 1 - h², s₂ = -2 h s₁, s₃ = (6 h² - 2) s₁):

    h_i = s₁ a_i,   h_ij = s₂ a_i a_j + s₁ a_ij,
    h_jkk = s₃ a_j a_k a_k + s₂ (a_j a_kk + 2 a_k a_jk) + s₁ a_jkk,   summed over the places k.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor

from ..checks import at_least
from ..ranges import ranged

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


@dataclass(frozen=True)
@ranged
class VelocityNetwork:
    """Options of the velocity."""

    solenoidal: bool = True
    """Whether the velocity is the curl of a potential, which has no divergence whatever the weights; else its three
    components are free."""
    hidden: int = 32
    """Units (tanh) of a hidden layer: flows of a channel are smooth."""
    layers: int = 2
    """Hidden layers."""

    def __post_init__(self) -> None:
        at_least(self, 1, "hidden", "layers")

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
