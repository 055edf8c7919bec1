"""Membranes on surfaces that were seen: a mesh of known rest shape is laid on each, with the least elastic energy.

Motion along a surface is not seen, so where the nodes of a membrane are on it is not known; of all places those of
least energy are taken.

Cells in a channel as a differentiable model of motion: where membranes are later, given where they are now.
The physics is that of `specimens/flow`: every node moves with the fluid, Stokes' flow without inertia, one viscosity
inside and outside, the channel's undisturbed flow and regularised Stokeslets of all membrane forces; no answer of the
walls to these. What is unknown of it are a few numbers (`Unknowns`), and all steps can be differentiated by them and by
the first state: the time steps are even, and each is computed again on the way back, so that memory is that of one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import ceil, sqrt

import numpy as np
import torch
from numpy.polynomial import Chebyshev
from scipy.optimize import minimize
from scipy.spatial import KDTree
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from ..bodies.rest_shape import moments, stretched_like
from ..checks import require
from ..mesh import TriangleMesh, areas, normals
from ..specimens.flow.suspension import Channel, Medium, Suspension, contact_forces, wall_forces
from ..specimens.membrane.model import Elasticity, Membrane

STIFFNESS = (1e-6, 3e-6, 1e-5, 3e-5, 1e-4, 1e-4, 1e-4)
"""Springs between the surfaces [N/m a node], one round after the other: at the last one, forces of the membrane, some
0.3 pN a node, move it by 0.003 µm."""
ITERATIONS = 40
"""Steps of L-BFGS in a round; between them the nearest places are found again."""
LENGTH, ENERGY = 1e-6, 1e-18
"""Units of the search: µm and pN µm."""


def dressed(meshes: Sequence[TriangleMesh], membrane: Membrane) -> np.ndarray:
    """Nodes [C, P, 3] [m] of `membrane` on the surfaces `meshes`, within 0.02 µm or so, of least elastic energy.

    Each takes on the area and the volume of its surface.
    """
    own = Membrane(membrane.mesh, membrane.elasticity)
    whole = {"surface": [mesh.area for mesh in meshes], "volume": [mesh.volume for mesh in meshes]}
    own.rest = replace(own.rest, **{name: torch.tensor(each).double() for name, each in whole.items()})
    seen = [_Seen(mesh, KDTree(mesh.vertices), normals(mesh), areas(mesh) / mesh.area) for mesh in meshes]
    nodes = np.array([_placed(mesh, membrane.mesh) for mesh in meshes])
    for stiffness in STIFFNESS:
        found = _Springs(own, stiffness, [one.pairs(at) for one, at in zip(seen, nodes)])
        start, options = (nodes / LENGTH).ravel(), {"maxiter": ITERATIONS}
        nodes = LENGTH * minimize(found, start, jac=True, method="L-BFGS-B", options=options).x.reshape(nodes.shape)
    require(
        bool(np.isfinite(nodes).all()),
        "membranes must fit the tracked surfaces, but one does not; track more times or beams, or use --by paths.",
    )
    return nodes


def scaled(rest: TriangleMesh, meshes: Sequence[TriangleMesh]) -> TriangleMesh:
    """The rest shape with the median volume of `meshes`."""
    wanted = float(np.median([mesh.volume for mesh in meshes]))
    return TriangleMesh(rest.vertices * (wanted / rest.volume) ** (1 / 3), rest.faces, rest.name)


@dataclass(frozen=True)
class Bound:
    """Points [Q, 3] of a surface that go with the triangles [F, 3] of a coarser one.

    faces: [Q, 3] nodes of the triangle of each; parts: [Q, 3] barycentric; offset: [Q, 3] [m] in the triangle's frame.
    """

    faces: torch.Tensor
    parts: torch.Tensor
    offset: torch.Tensor

    @classmethod
    def of(cls, points: np.ndarray, nodes: np.ndarray, faces: np.ndarray) -> Bound:
        """Each of `points` [Q, 3] [m] with the triangle whose middle is nearest."""
        corners = nodes[faces]
        nearest = KDTree(corners.mean(1)).query(points)[1]
        a, b, c = np.moveaxis(corners[nearest], 1, 0)
        plane = np.stack([b - a, c - a], axis=-1)
        gram = np.einsum("qxi,qxj->qij", plane, plane)
        along = np.einsum("qxi,qx->qi", plane, points - a)
        second, third = (np.linalg.pinv(gram) @ along[..., None])[..., 0].T  # of a triangle without area, too
        inside = np.maximum(np.stack([1 - second - third, second, third], axis=1), 0)
        parts = torch.from_numpy(inside / inside.sum(1, keepdims=True))
        chosen = torch.from_numpy(faces[nearest])
        tensor = torch.from_numpy(nodes)
        away = torch.from_numpy(points) - (parts[..., None] * tensor[chosen]).sum(1)
        return cls(chosen, parts, torch.einsum("qxi,qx->qi", _frames(tensor[chosen]), away))

    def places(self, nodes: torch.Tensor) -> torch.Tensor:
        """The points [Q, 3] [m] when the nodes are at `nodes` [P, 3] [m]."""
        corners = nodes[self.faces]
        return (self.parts[..., None] * corners).sum(1) + torch.einsum("qxi,qi->qx", _frames(corners), self.offset)


def _frames(corners: torch.Tensor) -> torch.Tensor:
    """Orthonormal axes [Q, 3, 3] (columns) of triangles [Q, 3, 3]."""
    a, b, c = corners.unbind(1)
    first = torch.nn.functional.normalize(b - a, dim=-1)
    normal = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=-1)
    return torch.stack([first, torch.linalg.cross(normal, first), normal], dim=-1)


@dataclass(frozen=True)
class _Seen:
    """A surface, what finds its nearest vertex, their normals [Q, 3], and their shares [Q] of its area."""

    mesh: TriangleMesh
    tree: KDTree
    outward: np.ndarray
    shares: np.ndarray

    def pairs(self, nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Of springs: nodes, points and normals of the surface, strengths; from each node, and to each vertex."""
        near, back = self.tree.query(nodes)[1], KDTree(nodes).query(self.mesh.vertices)[1]
        which, to = np.r_[np.arange(len(nodes)), back], np.r_[near, np.arange(len(self.outward))]
        return which, self.mesh.vertices[to], self.outward[to], np.r_[np.ones(len(nodes)), len(nodes) * self.shares]


class _Springs:
    """Membranes whose nodes are held to planes, by springs of a stiffness [N/m] and pairs of each surface."""

    def __init__(self, membrane: Membrane, stiffness: float, pairs: Sequence[tuple[np.ndarray, ...]]) -> None:
        size = len(membrane.mesh.vertices)
        self.membrane = membrane
        self.which = np.concatenate([size * k + one[0] for k, one in enumerate(pairs)])
        self.points, self.normals, strengths = (np.concatenate(part) for part in list(zip(*pairs))[1:])
        self.springs = 0.5 * stiffness * strengths

    def __call__(self, flat: np.ndarray) -> tuple[float, np.ndarray]:
        """Energy and its gradient, in the units of the search."""
        places = LENGTH * flat.reshape(-1, 3)
        away = ((places[self.which] - self.points) * self.normals).sum(1)
        nodes = torch.from_numpy(places.reshape(-1, *self.membrane.mesh.vertices.shape))
        energy = float(self.membrane.energy(nodes).sum()) + 0.5 * float((self.springs * away**2).sum())
        pull = self.membrane.forces(nodes).numpy().reshape(-1, 3)
        np.subtract.at(pull, self.which, (self.springs * away)[:, None] * self.normals)
        return energy / ENERGY, -(pull * (LENGTH / ENERGY)).ravel()


def _placed(mesh: TriangleMesh, rest: TriangleMesh) -> np.ndarray:
    """The nodes of `rest`, moved, turned and stretched such that its ellipsoid of second moments is that of `mesh`."""
    return (rest.vertices - moments(rest)[1]) @ stretched_like(mesh, rest).T + moments(mesh)[1]


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

    def as_dict(self, told: Mapping[str, float]) -> dict[str, float]:
        """Plain numbers, and standard errors after over those before, by name, that are `told`."""
        found = {"peak_m_s": float(self.peak), "shear_n_m": float(self.shear)}
        return found | {f"{name}_told": value for name, value in told.items()}


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
        self._other.rest = replace(self._other.rest, surface=areas, volume=volumes)
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


def advanced(
    velocity: Velocity,
    nodes: Tensor,
    duration: float,
    step: float,
    fastest: float = torch.inf,
    check: Callable[[Tensor, Tensor, float], None] = lambda before, after, step: None,
) -> Tensor:
    """`nodes` [..., 3] [m] after `duration` [s], in even steps of at most `step` [s], each given to `check`.

    Runge, Kutta and Chebyshev's method of second order (Sommeijer, Shampine & Verwer 1998, J. Comput. Appl. Math. 88,
    315), whose s stages are stable up to 0.65 (s² - 1) of the time `fastest` [s] in which the flow relaxes.
    Gradients flow through all steps; each is computed again for them.
    """
    count = max(1, round(duration / step + 0.499999))
    stages = max(2, ceil(sqrt(1 + duration / count / (0.65 * fastest))))
    for _ in range(count):
        args, before = (velocity, nodes, duration / count, stages), nodes
        recomputed = torch.is_grad_enabled()
        nodes = checkpoint(_step, *args, use_reentrant=False) if recomputed else _step(*args)
        check(before, nodes, duration / count)
    return nodes


def _step(velocity: Velocity, nodes: Tensor, step: float, stages: int) -> Tensor:
    middle = 1 + 2 / 13 / stages**2
    whole = [Chebyshev.basis(j) for j in range(stages + 1)]
    value, slope, bend = ([float(one.deriv(n)(middle)) for one in whole] for n in range(3))
    scale = slope[-1] / bend[-1]
    b = [bend[j] / slope[j] ** 2 for j in range(2, stages + 1)]
    b = [b[0], b[0], *b]
    first = velocity(nodes)
    before, now = nodes, nodes + b[1] * scale * step * first
    for j in range(2, stages + 1):
        more, less, push = 2 * b[j] / b[j - 1] * middle, -b[j] / b[j - 2], 2 * b[j] / b[j - 1] * scale * step
        still = push * (1 - b[j - 1] * value[j - 1])
        change = push * velocity(now) - still * first
        before, now = now, (1 - more - less) * nodes + more * now + less * before + change
    return now
