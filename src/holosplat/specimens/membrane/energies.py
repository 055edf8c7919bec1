"""Elastic energies of a membrane [J], each a differentiable function of its nodes.

The object-in-fluid model (Dupin et al. 2007, Phys. Rev. E 75, 066707; Cimrák, Gusenbauer & Schrefl 2012, Comput. Math.
Appl. 64, 278; Cimrák, Gusenbauer & Jančigová 2014, Comput. Phys. Commun. 185, 900) is springs along edges, bending,
local and global area, and volume; its forces were published; the energies here have these forces as gradients (areas:
in the form that has an energy). Skalak et al. (1973, Biophys. J. 13, 245) is the continuum alternative to springs.
Nodes are [..., P, 3] [m], energies [...].
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from .geometry import corners_of, dihedral_angles, edge_lengths, enclosed_volume, triangle_areas
from .rest import RestShape

ROOTS = tuple((math.cos(math.pi * k / 8), math.sin(math.pi * k / 8)) for k in (1, 3, 5, 7))
"""Real and imaginary parts of the roots of u⁸ = -1 in the upper half plane."""


def stretching_energy(nodes: Tensor, rest: RestShape, stiffness: float) -> Tensor:
    """Springs along edges, stiffness k [N/m]: Σ k L₀² ∫₁^λ κ(s) (s - 1) ds, λ = L/L₀, κ from `neo_hookean`."""
    ratio = edge_lengths(nodes, rest.edges) / rest.length
    return stiffness * (rest.length**2 * (_spring(ratio) - _spring(torch.ones_like(rest.length)))).sum(-1)


def linear_energy(nodes: Tensor, rest: RestShape, stiffness: float) -> Tensor:
    """Springs that do not soften, Σ k/2 (L - L₀)² over edges; stiffness k [N/m]."""
    return 0.5 * stiffness * ((edge_lengths(nodes, rest.edges) - rest.length) ** 2).sum(-1)


def neo_hookean(ratio: Tensor) -> Tensor:
    """κ(λ) = (λ^½ + λ^-2.5)/(λ + λ⁻³): springs soften as rubber does (Dupin 2007, eq. 19)."""
    return (ratio**0.5 + ratio**-2.5) / (ratio + ratio**-3)


def _spring(ratio: Tensor) -> Tensor:
    """∫ κ(λ) (λ - 1) dλ: with u = √λ the integrand is 2 (u² - 1 + (u² - 1)²/(u⁸ + 1)) du, in partial fractions."""
    u = ratio.sqrt()
    total = 2 * (u**3 / 3 - u)
    for real, imaginary in ROOTS:
        root = complex(real, imaginary)
        weight = -root * (root**2 - 1) ** 2 / 8  # the residue: 1/(8 r⁷) = -r/8
        distance = 0.5 * torch.log((u - real) ** 2 + imaginary**2)
        direction = torch.atan2(torch.full_like(u, imaginary), u - real)
        total = total + 4 * (weight.real * distance + weight.imag * direction)
    return total


def bending_energy(nodes: Tensor, rest: RestShape, stiffness: float) -> Tensor:
    """Σ over edges k/2 (θ - θ₀)², θ the angle between the triangles beside it; stiffness k [J].

    On even triangles k = 2κ/√3 gives the bending rigidity κ (Seung & Nelson 1988, Phys. Rev. A 38, 1005).
    """
    turn = dihedral_angles(nodes, rest.edges, rest.opposite) - rest.angle
    return 0.5 * stiffness * (turn**2).sum(-1)


def local_area_energy(nodes: Tensor, rest: RestShape, modulus: float) -> Tensor:
    """Σ over triangles k/2 (A - A₀)²/A₀; modulus k [N/m]."""
    areas = triangle_areas(corners_of(nodes, rest.faces))
    return 0.5 * modulus * ((areas - rest.area) ** 2 / rest.area).sum(-1)


def global_area_energy(nodes: Tensor, rest: RestShape, modulus: float) -> Tensor:
    """k/2 (S - S₀)²/S₀ of the whole surface S; modulus k [N/m]."""
    surface = triangle_areas(corners_of(nodes, rest.faces)).sum(-1)
    return 0.5 * modulus * (surface - rest.surface) ** 2 / rest.surface


def volume_energy(nodes: Tensor, rest: RestShape, modulus: float) -> Tensor:
    """k/2 (V - V₀)²/V₀; modulus k [N/m²]."""
    volume = enclosed_volume(corners_of(nodes, rest.faces))
    return 0.5 * modulus * (volume - rest.volume) ** 2 / rest.volume


def skalak_energy(nodes: Tensor, rest: RestShape, shear: float, dilation: float) -> Tensor:
    """∫ G/4 (I₁² + 2 I₁ - 2 I₂ + C I₂²) dA₀, I₁ = tr FᵀF - 2, I₂ = det FᵀF - 1 (Skalak 1973).

    shear: modulus G [N/m]; dilation: the number C, the area modulus being G (1 + 2 C). F is constant on a triangle.
    """
    gradient = deformation_gradient(corners_of(nodes, rest.faces), rest)
    first, second = strain_invariants(gradient)
    density = 0.25 * shear * (first**2 + 2 * first - 2 * second + dilation * second**2)
    return (rest.area * density).sum(-1)


def deformation_gradient(corners: Tensor, rest: RestShape) -> Tensor:
    """F [..., F, 3, 2] of triangles with `corners` [..., F, 3, 3] against their rest shape."""
    a, b, c = corners.unbind(-2)
    return torch.stack([b - a, c - a], dim=-1) @ rest.frame


def strain_invariants(gradient: Tensor) -> tuple[Tensor, Tensor]:
    """I₁ and I₂ [...] of deformation gradients [..., 3, 2]."""
    along, across = gradient.unbind(-1)
    xx, yy, xy = (along**2).sum(-1), (across**2).sum(-1), (along * across).sum(-1)
    return xx + yy - 2, xx * yy - xy**2 - 1
