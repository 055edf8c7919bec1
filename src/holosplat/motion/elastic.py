"""What it costs to deform a body of known rest shape: the elastic energy of its membrane, in likelihoods.

Frames decide what they can see of a shape; what they cannot see, the rest shape decides. The membrane is that of
`specimens.membrane`: Skalak's shear and dilation, bending of its edges, its whole area. Moduli go with the body's size,
so that a body twice as large and deformed alike costs as much.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from ..fit.batch import Batch
from ..fit.problem import Part
from ..mesh import TriangleMesh
from ..model import Model
from ..representations import MovingSurfaces
from ..specimens.membrane.model import Elasticity, Membrane
from .terms import COEFFICIENTS

BENDING, AREA = 8e-3, 345.0
"""Bending of an edge over shear modulus and squared radius, and the area's modulus over that of shear: of red cells
(`Elasticity`), 3.5e-19 J and 1e-3 N/m over 2.9e-6 N/m at a radius of 3.91 µm."""


class Elastic:
    """The energy of bodies of one rest shape, over that of strains of one: dimensionless, whatever the size.

    mesh: closed, in any unit of length; volume: standard deviation of the volume beside that at rest, a share.
    """

    def __init__(self, mesh: TriangleMesh, volume: float) -> None:
        area = float(np.linalg.norm(_normals(mesh), axis=1).sum())
        radius = (area / (4 * np.pi)) ** 0.5
        shear = 1 / area
        moduli = Elasticity(
            skalak_shear=shear,
            skalak_dilation=1.0,
            bending=BENDING * shear * radius**2,
            global_area=AREA * shear,
            volume=0.0,
        )
        self.membrane, self.spread = Membrane(mesh, moduli), volume

    def __call__(self, nodes: Tensor) -> Tensor:
        """[...] of nodes [..., P, 3] in the mesh's unit."""
        return _Energy.apply(nodes, self.membrane)  # type: ignore[no-any-return]

    def of_volume(self, nodes: Tensor) -> Tensor:
        """[...] half the squared deviation of the volume from that at rest, in standard deviations."""
        share = self.membrane.volume(nodes) / self.membrane.rest.volume - 1
        return 0.5 * (share / self.spread).square()


class _Energy(torch.autograd.Function):
    """The energy with the forces as its gradient, which cost a fifth of the automatic one."""

    @staticmethod
    def forward(ctx, nodes: Tensor, membrane: Membrane) -> Tensor:  # type: ignore[no-untyped-def, override]
        ctx.forces = membrane.forces(nodes) if nodes.requires_grad else None
        return membrane.energy(nodes)

    @staticmethod
    def backward(ctx, gradient: Tensor) -> tuple[Tensor, None]:  # type: ignore[no-untyped-def, override]
        return -ctx.forces * gradient[..., None, None], None


def _normals(mesh: TriangleMesh) -> np.ndarray:
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    return 0.5 * np.cross(b - a, c - a)
