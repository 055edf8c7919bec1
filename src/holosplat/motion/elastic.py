"""Elastic energy of bodies of known rest shape as a prior, and the terms of a fit of bodies in motion.

Frames decide what they can see of a shape; what they cannot see, the rest shape decides. The membrane is that of
`specimens.membrane`: Skalak's shear and dilation, bending of its edges, its whole area. Moduli go with the body's size,
so that a body twice as large and deformed alike costs as much.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from scipy.spatial import KDTree
from torch import Tensor
from torch.autograd.function import once_differentiable

from ..checks import require
from ..fit.problem import Batch, LossPart
from ..fit.terms.object import CurvatureVariation
from ..mesh import TriangleMesh
from ..model import Model
from ..representations import MovingSurfaces, TimeBasis
from ..specimens.membrane.model import Elasticity, Membrane

BENDING, AREA = 8e-3, 345.0
"""Bending of an edge over shear modulus and squared radius, and the area's modulus over that of shear: of red cells
(`Elasticity`), 3.5e-19 J and 1e-3 N/m over 2.9e-6 N/m at a radius of 3.91 µm."""


class Elastic:
    """The energy of bodies of one rest shape, a closed mesh, in units of its area times the shear modulus."""

    def __init__(self, mesh: TriangleMesh) -> None:
        area, extent = mesh.area, float((mesh.vertices.max(0) - mesh.vertices.min(0)).max())
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


COEFFICIENTS = "object.coefficients"


class OfPaths(ABC):
    """A term of a fit of bodies in motion: one part, `name`, of their paths."""

    def __init__(self, name: str, weight: float) -> None:
        self.names, self._weight, self.resolved = (name,), weight, {name: weight}

    def __call__(self, model: Model, batch: Batch) -> Sequence[LossPart]:
        """The one part."""
        return [LossPart(self.names[0], self._weight, self.value(model.parameters()[COEFFICIENTS], batch))]

    @abstractmethod
    def value(self, paths: Tensor, batch: Batch) -> Tensor:
        """[] of the coefficients `paths` [K, P, 3] [pixels]."""


def spread(basis: TimeBasis) -> Tensor:
    """[K + 1, K]: weights of the K coefficients of a path at one more times, evenly from its first to its last."""
    return torch.from_numpy(basis.weights(np.linspace(basis.first, basis.last, basis.count + 1)))


class RestShapeKept(OfPaths):
    """Σ over bodies of the mean over time of their elastic energy beside their rest shape."""

    def __init__(self, weight: float, elastic: Elastic, start: MovingSurfaces, count: int | None = None) -> None:
        """elastic: of a mesh in pixels, of which the first `count` bodies of `start`, or all, have the vertices, in its
        order."""
        super().__init__("rest_shape", weight)
        rest, nodes = elastic.membrane.rest, len(elastic.membrane.mesh.vertices)
        self._elastic, self._count = elastic, count or start.count
        self._nodes = self._count * nodes
        faces = torch.cat([rest.faces + k * nodes for k in range(self._count)])
        require(torch.equal(faces, start.faces[: len(faces)]), "bodies of a known rest shape must have its triangles.")
        self._weights = spread(start.basis)

    def value(self, paths: Tensor, batch: Batch) -> Tensor:
        """As the class says."""
        known = paths[:, : self._nodes]
        nodes = torch.einsum("tk,kpx->tpx", self._weights, known).unflatten(1, (self._count, -1))
        return self._elastic(nodes).mean(0).sum()


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


Size = Callable[[Tensor, Tensor, Tensor], Tensor]
"""What triangles of the corners a, b, c [F, 3] add to a size of a body: [F]."""


class MovingCurvature(OfPaths):
    """The mean over time of the energy of `CurvatureVariation`, all bodies together."""

    def __init__(self, weight: float, start: MovingSurfaces) -> None:
        super().__init__("curvature", weight)
        self._energy = CurvatureVariation(1.0, start.at(0.5 * (start.basis.first + start.basis.last))).energy
        self._weights = spread(start.basis)

    def value(self, paths: Tensor, batch: Batch) -> Tensor:
        """As the class says."""
        return self._energy(torch.einsum("tk,kpx->tpx", self._weights, paths)).mean()


class Acceleration(OfPaths):
    """Σ over bodies of the mean over vertices of the squared coefficients of acceleration [pixels² per piece⁴]."""

    def __init__(self, weight: float, start: MovingSurfaces) -> None:
        super().__init__("acceleration", weight)
        self._curvature = torch.from_numpy(start.basis.curvature())
        self._shares = torch.zeros(start.coefficients.shape[1], 1, dtype=torch.float64)
        for own, _ in map(start.body, range(start.count)):
            self._shares[own] = 1 / len(own)

    def value(self, paths: Tensor, batch: Batch) -> Tensor:
        """As the class says."""
        bent: Tensor = torch.einsum("jk,kpx->jpx", self._curvature, paths)
        return (self._shares * bent.square()).sum()


class SizeKept(OfPaths):
    """Σ over bodies of the mean over times of (S(t)/S - 1)², S(t) a size of a body and S its mean over time."""

    def __init__(self, name: str, size: Size, weight: float, start: MovingSurfaces, times: np.ndarray) -> None:
        """name: of the part; size: one number of each triangle, whose sum is that of the body; times: [T] s, over which
        means are taken."""
        super().__init__(name, weight)
        self._size, self._faces, self._body, self._count = size, start.faces, start.of_body, start.count
        self._weights = torch.from_numpy(start.basis.weights(times))

    def value(self, paths: Tensor, batch: Batch) -> Tensor:
        """As the class says."""
        sizes = torch.stack([self._sizes(torch.einsum("k,kpx->px", w, paths)) for w in self._weights])
        change = sizes / sizes.mean(0) - 1
        return change.square().mean(0).sum()

    def _sizes(self, vertices: Tensor) -> Tensor:
        """[B] of all bodies, about the middle of all vertices."""
        parts = self._size(*(vertices - vertices.detach().mean(0))[self._faces].unbind(1))
        return vertices.new_zeros(self._count).index_add(0, self._body, parts)


def _tetrahedra(a: Tensor, b: Tensor, c: Tensor) -> Tensor:
    """Signed volumes [F] between the origin and triangles of the corners a, b, c [F, 3]."""
    return (a * torch.linalg.cross(b, c)).sum(1) / 6


def _triangles(a: Tensor, b: Tensor, c: Tensor) -> Tensor:
    """Areas [F] of triangles of the corners a, b, c [F, 3]."""
    return 0.5 * torch.linalg.cross(b - a, c - a).norm(dim=1)


volume_kept = partial(SizeKept, "volume_kept", _tetrahedra)
"""The penalty on changes of the volume of each body, of a weight, a start and times."""
area_kept = partial(SizeKept, "area_kept", _triangles)
"""The same of its area."""


class Apart(OfPaths):
    """The mean over times of Σ over surfaces ∫ d² dA [pixels⁴], d the depth of a point in another body.

    The depth of a vertex is its distance from the tangent plane at the nearest vertex of the other body (whose normal
    tells inside from outside: Bærentzen & Aanæs 2005, IEEE Trans. Vis. Comput. Graph. 11, 243). Bodies whose boxes do
    not meet are not looked at; areas are those of the start. A step looks at the times of its own frames.
    """

    def __init__(self, weight: float, start: MovingSurfaces, times: np.ndarray) -> None:
        """times: [N] s, of the frames."""
        super().__init__("apart", weight)
        self._basis, self._times = start.basis, times
        self._vertices = [start.body(k)[0].numpy() for k in range(start.count)]
        self._faces = start.faces
        corners = start.at(start.basis.first).vertices.detach()[start.faces]
        areas = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).norm(dim=1) / 6
        self._areas = torch.zeros(start.coefficients.shape[1], dtype=torch.float64)
        self._areas.index_add_(0, start.faces.reshape(-1), areas.repeat_interleave(3))

    def value(self, paths: Tensor, batch: Batch) -> Tensor:
        """As the class says."""
        shown = self._times if batch.index is None else self._times[batch.index.numpy()]
        times = np.unique(shown)
        places = (torch.einsum("k,kpx->px", torch.from_numpy(w), paths) for w in self._basis.weights(times))
        return torch.stack([self.overlap(vertices) for vertices in places]).mean()

    def overlap(self, vertices: Tensor) -> Tensor:
        """Σ ∫ d² dA [] of surfaces with `vertices` [P, 3] [pixels], over the parts that lie in other bodies."""
        points = vertices.detach().numpy()
        found = list(self._near(points))
        if not found:
            return vertices.new_zeros(())
        own, other = (torch.from_numpy(np.concatenate(part)) for part in zip(*found))
        depth = -((vertices[own] - vertices[other]) * vertex_normals(vertices, self._faces)[other]).sum(1)
        return (self._areas[own] * depth.clamp_min(0).square()).sum()

    def _near(self, points: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Vertices in the box of another body, and the vertices of that one that are nearest to them."""
        bodies = [points[used] for used in self._vertices]
        low, high = (np.array([reach(body, axis=0) for body in bodies]) for reach in (np.min, np.max))
        meet = np.all((low[:, None] <= high[None]) & (low[None] <= high[:, None]), axis=2)
        for j in np.flatnonzero(meet.sum(1) > 1):
            tree = KDTree(bodies[j])
            for i in np.flatnonzero(meet[j]):
                inside = np.flatnonzero(np.all((bodies[i] >= low[j]) & (bodies[i] <= high[j]), axis=1))
                if i != j and len(inside):
                    yield self._vertices[i][inside], self._vertices[j][tree.query(bodies[i][inside])[1]]


def vertex_normals(places: Tensor, faces: Tensor) -> Tensor:
    """[..., P, 3] unit normals at the vertices, means of those of their triangles by area."""
    a, b, c = places[..., faces, :].unbind(-2)
    across = torch.linalg.cross(b - a, c - a)
    index = faces.T.reshape(-1)
    found = torch.zeros_like(places).index_add(-2, index, torch.cat([across, across, across], dim=-2))
    return torch.nn.functional.normalize(found, dim=-1)
