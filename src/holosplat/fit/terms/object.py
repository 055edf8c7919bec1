"""Terms on the object: on Gaussians themselves, and on the volume that any object adds up to."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import torch
from scipy.sparse import csr_array, diags_array, triu
from torch import Tensor
from torch.nn.functional import normalize

from ...geometry import Grid
from ...mesh import shell_labels
from ...model import Model
from ...representations import GaussianCloud, SurfaceMesh
from ...representations.isosurface import adjacency
from ..problem import FIXED, Batch, LossPart
from ..total_variation import total_variation
from . import comparisons
from .frames import Objective

DEPTH, VIEWS = 100.0, 8.0
"""Voxels along the beam, and views, for which the weights of the terms on the volume are meant. Few views give
the prior of the volume more weight; the weights go with one over the root of their number."""


class VolumeTerm:
    """Total variation, overfull and in-between occupancies of the volume that Gaussians add up to, a block at a time.

    bounded: whether an occupancy of one means something, so that more of it, or less, can be wrong.
    """

    def __init__(
        self, objective: Objective, block: Grid, depth: float, views: int, noise: float, bounded: bool
    ) -> None:
        """block: shape and pitch of what a step looks at; depth: voxels of the whole volume for each pixel of a frame
        (means over more rows than frames have would weigh less); noise: the share of the frames' contrast that is
        noise."""
        self._block = (block.shape, block.voxel_size[0])
        self._scale = depth / DEPTH * math.sqrt(VIEWS / views)
        levels = objective.two_levels * (1 + objective.noise_gain * noise)
        table = {"tv_volume": objective.tv_volume}
        if bounded:
            table |= {"overfull": objective.overfull, "two_levels": levels}
        self._weights = {name: weight for name, weight in table.items() if weight > 0}
        self.names = tuple(self._weights)
        self.resolved = {name: self._scale * weight for name, weight in self._weights.items()}
        """The weights, after noise and the number of views, of sums along the beam in voxels."""

    def __call__(self, model: Model, batch: Batch) -> Sequence[LossPart]:
        """The parts in use, where the batch looks at the volume."""
        if not (batch.volume and self._weights):
            return []
        cloud = model.object
        assert isinstance(cloud, GaussianCloud)
        density = cloud.density_around(batch.middle, *self._block)
        values: dict[str, Callable[[], Tensor]] = {
            "tv_volume": lambda: len(density) * total_variation(density, backend=cloud.backend),
            "overfull": lambda: comparisons.overfull(density),
            "two_levels": lambda: comparisons.two_levels(density),
        }
        ramps = {"two_levels": batch.progress}
        return [
            LossPart(name, batch.volume * weight * ramps.get(name, 1.0), self._scale * values[name]())
            for name, weight in self._weights.items()
        ]


class Anisotropy:
    """Gaussians longer than `limit` times their shortest axis."""

    names = ("anisotropy",)
    resolved = FIXED

    def __init__(self, weight: float, limit: float) -> None:
        self._weight, self._limit = weight, limit

    def __call__(self, model: Model, batch: Batch) -> Sequence[LossPart]:
        """The one part."""
        cloud = model.object
        assert isinstance(cloud, GaussianCloud)
        return [LossPart("anisotropy", self._weight, comparisons.anisotropy(cloud.log_scales, self._limit))]


class CurvatureVariation:
    """½ Σ over bodies of R² ∫ |∇H|² dA of surfaces, H the mean curvature, R = 3 V/A of a body's volume and area.

    The energy of minimum variation (Moreton & Séquin 1992, "Functional optimization for fair surface design",
    section 3) in units of the body's own size: balls and tubes have none, and a shape as much at any size. The
    mean of a vertex' neighbours is u away, n·u = h²/4 · 2H along the normal n on even triangles of edges h; R and h are
    those at the start. The same of u across the normal keeps triangles even.
    """

    names = ("curvature",)

    def __init__(self, weight: float, start: SurfaceMesh) -> None:
        """weight: of the energy; start: the surfaces at the beginning, whose triangles stay."""
        self._weight, self.resolved = weight, {"curvature": weight}
        faces, points = start.faces.cpu().numpy(), start.vertices.detach().cpu().double().numpy()
        a, b, c = np.moveaxis(points[faces], 1, 0)
        normals = np.cross(b - a, c - a)
        shells = shell_labels(faces, len(points))
        areas = np.bincount(shells, 0.5 * np.linalg.norm(normals, axis=1))
        volumes = np.bincount(shells, np.einsum("fi,fi->f", a, normals) / 6)
        radius, cell = 3 * np.abs(volumes) / areas, areas / (0.5 * np.bincount(shells))
        # a vertex has half its triangles, √3/2 h², and three edges, whose Σ (h²/2 · h ∂H)² is 3/2 (h³/2 |∇H|)²: in all
        # cell²/√3 ∫ |∇H|² dA
        of_vertex = np.zeros(len(points))
        of_vertex[faces] = (np.sqrt(3) * (radius / cell) ** 2)[shells][:, None]
        edges = adjacency(faces, len(points))
        upper, there = triu(edges, format="coo"), start.vertices.device
        self._ends = torch.from_numpy(np.stack([upper.row, upper.col]).astype(np.int64)).to(there)
        self._stiffness = torch.from_numpy(of_vertex[upper.row]).to(there)
        self._degree = torch.from_numpy(np.maximum(edges.sum(1), 1))[:, None].to(there)
        self._faces = start.faces.long()

    def __call__(self, model: Model, batch: Batch) -> Sequence[LossPart]:
        """The one part."""
        return [LossPart("curvature", self._weight, self.energy(model.parameters()["object.vertices"]))]

    def energy(self, x: Tensor) -> Tensor:
        """Energies [...] of the same triangles with vertices x [..., P, 3] in the unit of the start's."""
        i, j = self._ends
        a, b, c = (x[..., self._faces[:, k], :] for k in range(3))
        across, corners = torch.linalg.cross(b - a, c - a), self._faces.T.flatten()
        normals = normalize(torch.zeros_like(x).index_add(-2, corners, torch.cat([across] * 3, dim=-2)), dim=-1)
        around = torch.zeros_like(x).index_add(-2, i, x[..., j, :]).index_add(-2, j, x[..., i, :])
        away = x - around / self._degree
        along = (normals * away).sum(-1)
        aside = away - normals * along[..., None]
        change = (along[..., i] - along[..., j]).square() + (aside[..., i, :] - aside[..., j, :]).square().sum(-1)
        return 0.5 * (self._stiffness * change).sum(-1)


class VoxelVariation:
    """∫ |∇u| of voxel values [voxel edges²], smoothed below `smoothing`."""

    names = ("variation",)

    def __init__(self, weight: float, smoothing: float) -> None:
        self._weight, self._smoothing = weight, smoothing
        self.resolved = {"variation": weight}

    def __call__(self, model: Model, batch: Batch) -> Sequence[LossPart]:
        """The one part."""
        values = model.parameters()["object.values"]
        return [LossPart("variation", self._weight, total_variation(values, self._smoothing, "cpu") * values.numel())]


class Neighbours:
    """A sparse matrix [P, Q] float64 as lists of equal length: every row's columns and weights, padded with zeros.

    On a device where rows are short and alike in length, as of neighbours on a mesh.
    """

    def __init__(self, matrix: csr_array, on: torch.device) -> None:
        """on: where it multiplies."""
        counts = np.diff(matrix.indptr)
        there = np.arange(counts.max(initial=0)) < counts[:, None]
        columns, weights = np.zeros(there.shape, dtype=np.int64), np.zeros(there.shape)
        columns[there], weights[there] = matrix.indices, matrix.data
        self._columns, self._weights = torch.from_numpy(columns).to(on), torch.from_numpy(weights).to(on)

    def __matmul__(self, x: Tensor) -> Tensor:
        """The product [P, C] with x [Q, C] float64 on the same device; nothing waits for it."""
        found = x.index_select(0, self._columns.flatten()).reshape(*self._columns.shape, x.shape[1])
        return (self._weights[..., None] * found).sum(1)


def membrane_inverse(
    edges: csr_array, stiffness: float, on: torch.device, error: float = 1e-9
) -> Callable[[Tensor], Tensor]:
    """The inverse of 1 + λΔ, Δ = D - W, for x [P, C] float64 on a device, by a fixed number of products.

    edges: W [P, P], symmetric, not negative; D: its rows' sums; stiffness: λ; error: of what is found, relative, in the
    norm of the diagonal M = 1 + λD.

    Chebyshev's iteration (Saad 2003, "Iterative Methods for Sparse Linear Systems", section 12.3) with the
    preconditioner M: the eigenvalues of λ M⁻¹W lie between -ρ and ρ = 1 - 1/(1 + λ d), d the largest in D, so that
    those of M⁻¹(1 + λΔ) lie around 1, and n steps leave less than 1/T_n(1/ρ) of the error, T_n Chebyshev's polynomial.
    """
    sums = edges.sum(1)
    diagonal = 1 + stiffness * sums
    reach = 1 - 1 / float(diagonal.max())
    step = Neighbours(csr_array(diags_array(stiffness / diagonal) @ edges), on)
    inverse = torch.from_numpy(1 / diagonal).to(on)[:, None]
    weights = _weights(reach, math.ceil(math.acosh(1 / error) / math.acosh(1 / reach)) if reach > 0 else 1)

    def solve(x: Tensor) -> Tensor:
        start = inverse * x
        before, found = torch.zeros_like(start), start
        for weight in weights:
            before, found = found, torch.lerp(before, torch.add(start, step @ found), weight)
        return found

    return solve


def _weights(reach: float, steps: int) -> list[float]:
    """What each step but the first, which is Jacobi's, takes of Jacobi's next one; the rest is that before the last."""
    found, last = list[float](), 2.0
    for _ in range(steps - 1):
        last = 1 / (1 - 0.25 * reach**2 * last)
        found.append(last)
    return found
