"""The membrane of a cell: its rest shape and elastic moduli, its energies and forces.

Elastic energies of a membrane [J], each a differentiable function of its nodes.
The object-in-fluid model (Dupin et al. 2007, Phys. Rev. E 75, 066707; Cimrák, Gusenbauer & Schrefl 2012, Comput. Math.
Appl. 64, 278; Cimrák, Gusenbauer & Jančigová 2014, Comput. Phys. Commun. 185, 900) is springs along edges, bending,
local and global area, and volume; its forces were published; the energies here have these forces as gradients (areas:
in the form that has an energy). Skalak et al. (1973, Biophys. J. 13, 245) is the continuum alternative to springs.
Nodes are [..., P, 3] [m], energies [...].
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ...mesh import TriangleMesh
from ...ranges import checked_dataclass
from .rest import (
    RestShape,
    angle_between,
    area_vectors,
    corners_of,
    cross,
    dihedral_angles,
    edge_lengths,
    enclosed_volume,
    triangle_areas,
)


@dataclass(frozen=True, eq=False)
class Shape:
    """Nodes [..., P, 3] [m], the triangles' corners [..., F, 3, 3] and normals [..., F, 3] (twice the area long)."""

    nodes: Tensor
    corners: Tensor
    normals: Tensor

    @classmethod
    def of(cls, nodes: Tensor, rest: RestShape) -> Shape:
        """The shared quantities, computed once."""
        corners = corners_of(nodes, rest.faces)
        return cls(nodes, corners, area_vectors(corners))

    @property
    def areas(self) -> Tensor:
        """[..., F] [m²]."""
        return 0.5 * self.normals.norm(dim=-1)


def stretching_forces(shape: Shape, rest: RestShape, softening: float, linear: float) -> Tensor:
    """Of the springs: (k κ(λ) + k') (L - L₀) along each edge (Dupin 2007, eq. 18); stiffnesses k, k' [N/m]."""
    edge = shape.nodes[..., rest.edges[:, 1], :] - shape.nodes[..., rest.edges[:, 0], :]
    length = edge.norm(dim=-1)
    stiffness = softening * neo_hookean(length / rest.length) + linear if softening else linear
    pulls = (stiffness * (length - rest.length) / length).unsqueeze(-1) * edge
    return _gathered(shape.nodes, rest.edges, torch.stack([pulls, -pulls], dim=-2))


THIN = 0.1
"""Of the rest area of a triangle, below which bending does not grow stronger."""


def bending_forces(shape: Shape, rest: RestShape, stiffness: float) -> Tensor:
    """Of the hinges, by the gradient of the dihedral angle (Guckenberger et al. 2016, Comput. Phys. Commun. 207, 1).

    A triangle without area has no direction: one of less than `THIN` of its rest area has the levers of that much.
    """
    (a, b), (c, d) = (shape.nodes[..., pair, :].unbind(-2) for pair in (rest.edges, rest.opposite))
    edge = b - a
    length = edge.norm(dim=-1, keepdim=True)
    first, second = shape.normals[..., rest.beside, :].unbind(-2)
    turn = stiffness * (angle_between(edge, first, second) - rest.angle).unsqueeze(-1)
    least = (2 * THIN * rest.area[rest.beside].unsqueeze(-1)) ** 2
    first, second = (
        turn * n / (n**2).sum(-1, keepdim=True).clamp(min=low) for n, low in zip((first, second), least.unbind(-2))
    )
    on_a = -(((b - c) * edge).sum(-1, keepdim=True) * first + ((b - d) * edge).sum(-1, keepdim=True) * second) / length
    on_b = -(((c - a) * edge).sum(-1, keepdim=True) * first + ((d - a) * edge).sum(-1, keepdim=True) * second) / length
    forces = torch.stack([on_a, on_b, length * first, length * second], dim=-2)
    return _gathered(shape.nodes, torch.cat([rest.edges, rest.opposite], dim=1), forces)


def area_forces(shape: Shape, rest: RestShape, local: float, whole: float) -> Tensor:
    """Of the tension k (A - A₀)/A₀ in each triangle and k (S - S₀)/S₀ in all of them, moduli [N/m]."""
    areas = shape.areas
    tension = local * (areas / rest.area - 1)
    tension = tension + whole * (areas.sum(-1) / rest.surface - 1).unsqueeze(-1)
    unit = 0.5 * shape.normals / areas.unsqueeze(-1)
    pull = 0.5 * tension.unsqueeze(-1) * unit
    a, b, c = shape.corners.unbind(-2)
    forces = torch.stack([-cross(pull, c - b), -cross(pull, a - c), -cross(pull, b - a)], dim=-2)
    return _gathered(shape.nodes, rest.faces, forces)


def volume_forces(shape: Shape, rest: RestShape, modulus: float) -> Tensor:
    """Of the pressure -k (V - V₀)/V₀ [N/m²]: a third of each triangle's area vector on each of its corners."""
    pressure = -modulus * (enclosed_volume(shape.corners) / rest.volume - 1)
    forces = pressure[..., None, None] * shape.normals / 6
    return _gathered(shape.nodes, rest.faces, forces.unsqueeze(-2).expand(*forces.shape[:-1], 3, 3))


def skalak_forces(shape: Shape, rest: RestShape, shear: float, dilation: float) -> Tensor:
    """Of Skalak's membrane, -A₀ P B with the stress P = ∂W/∂F and the shape functions' gradients B."""
    gradient = deformation_gradient(shape.corners, rest)
    first, second = strain_invariants(gradient)
    by_first = (0.5 * shear * (first + 1)).unsqueeze(-1)
    by_second = (0.5 * shear * (dilation * second - 1)).unsqueeze(-1)
    along, across = gradient.unbind(-1)
    xx, yy, xy = (p.unsqueeze(-1) for p in ((along**2).sum(-1), (across**2).sum(-1), (along * across).sum(-1)))
    stress = torch.stack(
        [2 * (by_first + by_second * yy) * along - 2 * by_second * xy * across,
         2 * (by_first + by_second * xx) * across - 2 * by_second * xy * along], dim=-1
    )  # fmt: skip
    on_b, on_c = (-rest.area[:, None, None] * (stress @ rest.frame.transpose(-1, -2))).unbind(-1)
    return _gathered(shape.nodes, rest.faces, torch.stack([-on_b - on_c, on_b, on_c], dim=-2))


def _gathered(nodes: Tensor, index: Tensor, forces: Tensor) -> Tensor:
    """The sum [..., P, 3] of `forces` [..., K, n, 3] on the nodes `index` [K, n]."""
    flat = forces.reshape(*forces.shape[:-3], -1, 3)
    return torch.zeros_like(nodes).index_add(-2, index.reshape(-1), flat)


@checked_dataclass
class Elasticity:
    """Elastic moduli of a membrane; a modulus of 0 leaves the energy out.

    With the defaults a cell in optical tweezers behaves as measured (docs/notebook/cells.md).
    """

    skalak_shear: float = 2.9e-6
    """Skalak's shear modulus G [N/m]."""
    skalak_dilation: float = 1.0
    """Skalak's number C: the area modulus is G (1 + 2 C)."""
    springs: float = 0.0
    """Or: springs along edges that soften as rubber does, k_s [N/m]; the shear modulus is √3/4 of it."""
    linear_springs: float = 0.0
    """Springs along edges that do not soften, k_lin [N/m]."""
    bending: float = 3.5e-19
    """Bending of an edge, k_b [J]; on even triangles the bending rigidity is √3/2 of it."""
    local_area: float = 0.0
    """Area of each triangle, k_al [N/m]."""
    global_area: float = 1e-3
    """Area of the whole surface, k_ag [N/m]."""
    volume: float = 3e3
    """Volume, k_v [N/m²]."""


class Membrane:
    """The elastic surface of a cell, a closed mesh (else `InputError`, see `RestShape.of`).

    All methods take nodes [..., P, 3] [m], any number of cells of this rest shape.
    """

    def __init__(
        self, mesh: TriangleMesh, elasticity: Elasticity = Elasticity(), device: torch.device | str = "cpu"
    ) -> None:
        self.mesh = mesh
        self.elasticity = elasticity
        self.rest = RestShape.of(mesh).to(device=device)

    def energies(self, nodes: Tensor) -> dict[str, Tensor]:
        """Each energy [...] [J] with a modulus other than 0, by its name."""
        of, rest, shape = self.elasticity, self.rest, Shape.of(nodes, self.rest)
        length, found = edge_lengths(nodes, rest.edges), dict[str, Tensor]()
        if of.springs:  # Σ k L₀² ∫₁^λ κ(s) (s - 1) ds, λ = L/L₀, κ from `neo_hookean`
            work = _spring(length / rest.length) - _spring(torch.ones_like(rest.length))
            found["stretching"] = of.springs * (rest.length**2 * work).sum(-1)
        if of.linear_springs:  # Σ k/2 (L - L₀)² over edges
            found["linear stretching"] = 0.5 * of.linear_springs * ((length - rest.length) ** 2).sum(-1)
        if of.skalak_shear:  # ∫ G/4 (I₁² + 2 I₁ - 2 I₂ + C I₂²) dA₀, I₁ = tr FᵀF - 2, I₂ = det FᵀF - 1 (Skalak 1973)
            first, second = strain_invariants(deformation_gradient(shape.corners, rest))
            density = 0.25 * of.skalak_shear * (first**2 + 2 * first - 2 * second + of.skalak_dilation * second**2)
            found["skalak"] = (rest.area * density).sum(-1)
        if of.bending:  # Σ k/2 (θ - θ₀)², θ between the triangles beside an edge; on even triangles k = 2κ/√3 gives the
            # bending rigidity κ (Seung & Nelson 1988, Phys. Rev. A 38, 1005)
            turn = dihedral_angles(nodes, rest.edges, rest.opposite) - rest.angle
            found["bending"] = 0.5 * of.bending * (turn**2).sum(-1)
        if of.local_area:  # Σ k/2 (A - A₀)²/A₀ over triangles
            found["local area"] = 0.5 * of.local_area * ((shape.areas - rest.area) ** 2 / rest.area).sum(-1)
        if of.global_area:  # k/2 (S - S₀)²/S₀ of the whole surface
            found["global area"] = 0.5 * of.global_area * (shape.areas.sum(-1) - rest.surface) ** 2 / rest.surface
        if of.volume:  # k/2 (V - V₀)²/V₀
            found["volume"] = 0.5 * of.volume * (enclosed_volume(shape.corners) - rest.volume) ** 2 / rest.volume
        return found

    def energy(self, nodes: Tensor) -> Tensor:
        """The elastic energy [...] [J]."""
        return sum(self.energies(nodes).values(), nodes.new_zeros(nodes.shape[:-2]))

    def forces(self, nodes: Tensor) -> Tensor:
        """Forces [..., P, 3] [N] on the nodes: minus the energy's gradient, by hand."""
        of, rest = self.elasticity, self.rest
        shape = Shape.of(nodes, rest)
        total = torch.zeros_like(nodes)
        if of.springs or of.linear_springs:
            total = total + stretching_forces(shape, rest, of.springs, of.linear_springs)
        if of.skalak_shear:
            total = total + skalak_forces(shape, rest, of.skalak_shear, of.skalak_dilation)
        if of.bending:
            total = total + bending_forces(shape, rest, of.bending)
        if of.local_area or of.global_area:
            total = total + area_forces(shape, rest, of.local_area, of.global_area)
        if of.volume:
            total = total + volume_forces(shape, rest, of.volume)
        return total

    def surface(self, nodes: Tensor) -> Tensor:
        """Area [...] [m²]."""
        return triangle_areas(corners_of(nodes, self.rest.faces)).sum(-1)

    def volume(self, nodes: Tensor) -> Tensor:
        """Enclosed volume [...] [m³]."""
        return enclosed_volume(corners_of(nodes, self.rest.faces))


ROOTS = tuple((math.cos(math.pi * k / 8), math.sin(math.pi * k / 8)) for k in (1, 3, 5, 7))
"""Real and imaginary parts of the roots of u⁸ = -1 in the upper half plane."""


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


def deformation_gradient(corners: Tensor, rest: RestShape) -> Tensor:
    """F [..., F, 3, 2] of triangles with `corners` [..., F, 3, 3] against their rest shape."""
    a, b, c = corners.unbind(-2)
    return torch.stack([b - a, c - a], dim=-1) @ rest.frame


def strain_invariants(gradient: Tensor) -> tuple[Tensor, Tensor]:
    """I₁ and I₂ [...] of deformation gradients [..., 3, 2]."""
    along, across = gradient.unbind(-1)
    xx, yy, xy = (along**2).sum(-1), (across**2).sum(-1), (along * across).sum(-1)
    return xx + yy - 2, xx * yy - xy**2 - 1
