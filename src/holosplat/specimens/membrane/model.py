"""The membrane of a cell: its rest shape and elastic moduli, its energies and forces."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ...mesh import TriangleMesh
from ...ranges import ranged
from . import energies, forces
from .geometry import corners_of, enclosed_volume, triangle_areas
from .rest import RestShape


@dataclass(frozen=True)
@ranged
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

    def __init__(self, mesh: TriangleMesh, elasticity: Elasticity = Elasticity()) -> None:
        self.mesh = mesh
        self.elasticity = elasticity
        self.rest = RestShape.of(mesh)

    def energies(self, nodes: Tensor) -> dict[str, Tensor]:
        """Each energy [...] [J] with a modulus other than 0, by its name."""
        of, rest = self.elasticity, self.rest
        found = {}
        if of.springs:
            found["stretching"] = energies.stretching_energy(nodes, rest, of.springs)
        if of.linear_springs:
            found["linear stretching"] = energies.linear_energy(nodes, rest, of.linear_springs)
        if of.skalak_shear:
            found["skalak"] = energies.skalak_energy(nodes, rest, of.skalak_shear, of.skalak_dilation)
        if of.bending:
            found["bending"] = energies.bending_energy(nodes, rest, of.bending)
        if of.local_area:
            found["local area"] = energies.local_area_energy(nodes, rest, of.local_area)
        if of.global_area:
            found["global area"] = energies.global_area_energy(nodes, rest, of.global_area)
        if of.volume:
            found["volume"] = energies.volume_energy(nodes, rest, of.volume)
        return found

    def energy(self, nodes: Tensor) -> Tensor:
        """The elastic energy [...] [J]."""
        return sum(self.energies(nodes).values(), nodes.new_zeros(nodes.shape[:-2]))

    def forces(self, nodes: Tensor) -> Tensor:
        """Forces [..., P, 3] [N] on the nodes: minus the energy's gradient, by hand."""
        of, rest = self.elasticity, self.rest
        shape = forces.Shape.of(nodes, rest)
        total = torch.zeros_like(nodes)
        if of.springs or of.linear_springs:
            total = total + forces.stretching_forces(shape, rest, of.springs, of.linear_springs)
        if of.skalak_shear:
            total = total + forces.skalak_forces(shape, rest, of.skalak_shear, of.skalak_dilation)
        if of.bending:
            total = total + forces.bending_forces(shape, rest, of.bending)
        if of.local_area or of.global_area:
            total = total + forces.area_forces(shape, rest, of.local_area, of.global_area)
        if of.volume:
            total = total + forces.volume_forces(shape, rest, of.volume)
        return total

    def surface(self, nodes: Tensor) -> Tensor:
        """Area [...] [m²]."""
        return triangle_areas(corners_of(nodes, self.rest.faces)).sum(-1)

    def volume(self, nodes: Tensor) -> Tensor:
        """Enclosed volume [...] [m³]."""
        return enclosed_volume(corners_of(nodes, self.rest.faces))
