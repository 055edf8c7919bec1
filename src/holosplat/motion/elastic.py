"""Elastic energy of bodies of known rest shape as a prior: that of their membranes, in likelihoods.

Frames decide what they can see of a shape; what they cannot see, the rest shape decides. The membrane is that of
`specimens.membrane`: Skalak's shear and dilation, bending of its edges, its whole area. Moduli go with the body's size,
so that a body twice as large and deformed alike costs as much.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ..bodies.rest_shape import surface
from ..checks import require
from ..fit.problem import Batch, LossPart
from ..mesh import TriangleMesh
from ..model import Model
from ..representations import MovingSurfaces
from ..specimens.membrane.model import Elasticity, Membrane
from .terms import COEFFICIENTS

BENDING, AREA = 8e-3, 345.0
"""Bending of an edge over shear modulus and squared radius, and the area's modulus over that of shear: of red cells
(`Elasticity`), 3.5e-19 J and 1e-3 N/m over 2.9e-6 N/m at a radius of 3.91 µm."""


class Elastic:
    """The energy of bodies of one rest shape, a closed mesh, in units of its area times the shear modulus."""

    def __init__(self, mesh: TriangleMesh) -> None:
        area, extent = surface(mesh), float((mesh.vertices.max(0) - mesh.vertices.min(0)).max())
        moduli = Elasticity(
            skalak_shear=1 / area,
            skalak_dilation=1.0,
            bending=BENDING / area * (0.5 * extent) ** 2,
            global_area=AREA / area,
            volume=0.0,
        )
        self.membrane = Membrane(mesh, moduli)

    def __call__(self, nodes: Tensor) -> Tensor:
        """Energies [...] of nodes [..., P, 3] in the mesh's unit, dimensionless; 0 at rest, in any pose."""
        return _Energy.apply(nodes, self.membrane)  # type: ignore[no-any-return]


@dataclass(frozen=True)
class Rest:
    """The known shape of all bodies at rest. elastic: their energy, lengths in the unit of their paths; stiffness:
    minus the logarithm of the probability of a unit of it."""

    elastic: Elastic
    stiffness: float

    @classmethod
    def of(cls, shape: TriangleMesh, stiffness: float, unit: float) -> Rest:
        """Prior of bodies whose shape at rest is the mesh `shape` [m], on paths in `unit` [m]."""
        return cls(Elastic(TriangleMesh(shape.vertices / unit, shape.faces, shape.name)), stiffness)


class _Energy(torch.autograd.Function):
    """The energy with the forces as its gradient, which cost a fifth of the automatic one."""

    @staticmethod
    def forward(ctx: Any, nodes: Tensor, membrane: Membrane) -> Tensor:  # type: ignore[override]
        ctx.forces = membrane.forces(nodes) if ctx.needs_input_grad[0] else None
        return membrane.energy(nodes)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:  # type: ignore[override]
        return -ctx.forces * gradient[..., None, None], None


class RestShapeKept:
    """Σ over bodies of the mean over time of their elastic energy beside their rest shape."""

    names = ("rest_shape",)

    def __init__(self, weight: float, elastic: Elastic, start: MovingSurfaces) -> None:
        """elastic: of a mesh in pixels, of which all bodies of `start` have the vertices, in its order."""
        rest = elastic.membrane.rest
        self._weight, self._elastic, self._count = weight, elastic, start.count
        faces = torch.cat([rest.faces + k * len(elastic.membrane.mesh.vertices) for k in range(start.count)])
        require(torch.equal(faces, start.faces), "bodies of a known rest shape must have its triangles.")
        instants = torch.linspace(start.basis.first, start.basis.last, start.basis.count + 1, dtype=torch.float64)
        self._weights = torch.from_numpy(start.basis.weights(instants.numpy()))
        self.resolved = {"rest_shape": weight}

    def __call__(self, model: Model, batch: Batch) -> Sequence[LossPart]:
        """The one part."""
        paths = model.parameters()[COEFFICIENTS]
        nodes = torch.einsum("tk,kpx->tpx", self._weights, paths).unflatten(1, (self._count, -1))
        return [LossPart("rest_shape", self._weight, self._elastic(nodes).mean(0).sum())]


RED_CELL = Elasticity(global_area=0.0, volume=0.0)
"""Shear, dilation and bending of a red cell's membrane (docs/cells.md): what is stored in it, without what keeps its
area and volume in a simulation."""


def strain_energy(
    bodies: MovingSurfaces, times: np.ndarray, rest: TriangleMesh, elasticity: Elasticity = RED_CELL
) -> np.ndarray:
    """[T, B] J of each body at `times` [s]: 0 in the shape of `rest` [m], in any pose.

    Energies compare triangles with themselves, so that all bodies must have the triangles of `rest`, in its order;
    motion along a surface, which frames do not see, counts as strain. Errors: `InputError` for other triangles.
    """
    parts = [bodies.body(k) for k in range(bodies.count)]
    wanted = torch.tensor(rest.faces)
    require(
        all(torch.equal(faces, wanted) for _, faces in parts),
        f"strain energy needs bodies of the triangles of the shape at rest, {len(rest.faces)} each, but these have "
        "others; follow bodies of a known shape.",
    )
    membrane, found = Membrane(rest, elasticity), []
    for time in times:
        nodes = np.stack([mesh.vertices for mesh in bodies.bodies(float(time))])
        found.append(membrane.energy(torch.from_numpy(nodes)).numpy())
    return np.array(found)
