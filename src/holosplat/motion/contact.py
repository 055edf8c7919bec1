"""The penalty for overlap of bodies, on pairs whose surfaces are close."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import torch
from scipy.spatial import KDTree
from torch import Tensor

from ..fit.problem import Batch, LossPart
from ..model import Model
from ..representations import MovingSurfaces
from .terms import COEFFICIENTS


class Apart:
    """The mean over times of Σ over surfaces ∫ d² dA [pixels⁴], d the depth of a point in another body.

    The depth of a vertex is its distance from the tangent plane at the nearest vertex of the other body (whose normal
    tells inside from outside: Bærentzen & Aanæs 2005, IEEE Trans. Vis. Comput. Graph. 11, 243). Bodies whose boxes do
    not meet are not looked at; areas are those of the start. A step looks at the times of its own frames.
    """

    names = ("apart",)

    def __init__(self, weight: float, start: MovingSurfaces, times: np.ndarray) -> None:
        """times: [N] s, of the frames."""
        self._weight, self._basis, self._times = weight, start.basis, times
        self._vertices = [start.body(k)[0].numpy() for k in range(start.count)]
        self._faces = start.faces
        corners = start.at(start.basis.first).vertices.detach()[start.faces]
        areas = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).norm(dim=1) / 6
        self._areas = torch.zeros(start.coefficients.shape[1], dtype=torch.float64)
        self._areas.index_add_(0, start.faces.reshape(-1), areas.repeat_interleave(3))
        self.resolved = {"apart": weight}

    def __call__(self, model: Model, batch: Batch) -> Sequence[LossPart]:
        """The one part."""
        paths = model.parameters()[COEFFICIENTS]
        shown = self._times if batch.index is None else self._times[batch.index.numpy()]
        times = np.unique(shown)
        places = (torch.einsum("k,kpx->px", torch.from_numpy(w), paths) for w in self._basis.weights(times))
        return [LossPart("apart", self._weight, torch.stack([self.overlap(vertices) for vertices in places]).mean())]

    def overlap(self, vertices: Tensor) -> Tensor:
        """Σ ∫ d² dA [] of surfaces with `vertices` [P, 3] [pixels], over the parts that lie in other bodies."""
        points = vertices.detach().numpy()
        found = list(self._near(points))
        if not found:
            return vertices.new_zeros(())
        own, other = (torch.from_numpy(np.concatenate(part)) for part in zip(*found))
        depth = -((vertices[own] - vertices[other]) * self._normals(vertices)[other]).sum(1)
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

    def _normals(self, vertices: Tensor) -> Tensor:
        """Unit normals [P, 3], means of those of the triangles around by area."""
        a, b, c = vertices[self._faces].unbind(1)
        across = torch.linalg.cross(b - a, c - a)
        sums = torch.zeros_like(vertices).index_add(0, self._faces.reshape(-1), across.repeat_interleave(3, 0))
        return sums / sums.norm(dim=1, keepdim=True).clamp_min(1e-30)
