"""What surfaces in motion cost beside what frames say: bending of surfaces and of paths."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from scipy.sparse import csr_array, eye_array
from torch import Tensor

from ..fit.batch import Batch
from ..fit.problem import Part
from ..fit.terms.object import squared_product
from ..model import Model
from ..representations import MovingSurfaces
from ..representations.isosurface import neighbour_mean

COEFFICIENTS = "object.coefficients"


class MovingBending:
    """The mean over times of Σ |L² x|² of the vertices x [pixels], L x their distance from their neighbours' mean."""

    names = ("bending",)

    def __init__(self, weight: float, start: MovingSurfaces, times: np.ndarray) -> None:
        """times: [T] s, over which the mean is taken."""
        count = start.coefficients.shape[1]
        away = csr_array(eye_array(count) - neighbour_mean(start.faces.numpy(), count))
        operator = csr_array(away @ away)
        self._weight, self._operators = weight, (operator, csr_array(operator.T))
        self._root = torch.from_numpy(square_root(start.basis.gram(times)))
        self.resolved = {"bending": weight}

    def __call__(self, model: Model, batch: Batch) -> Sequence[Part]:
        """The one part."""
        paths = torch.einsum("kl,lpx->pkx", self._root, model.parameters()[COEFFICIENTS])
        return [Part("bending", self._weight, squared_product(paths.flatten(1), *self._operators))]


class Acceleration:
    """The mean over vertices of the squared coefficients of their acceleration [pixels² per piece⁴]."""

    names = ("acceleration",)

    def __init__(self, weight: float, start: MovingSurfaces) -> None:
        self._weight = weight
        self._curvature = torch.from_numpy(start.basis.curvature())
        self.resolved = {"acceleration": weight}

    def __call__(self, model: Model, batch: Batch) -> Sequence[Part]:
        """The one part."""
        paths = model.parameters()[COEFFICIENTS]
        bent: Tensor = torch.einsum("jk,kpx->jpx", self._curvature, paths)
        return [Part("acceleration", self._weight, bent.square().sum() / paths.shape[1])]


class VolumeKept:
    """Σ over bodies of the mean over times of (V(t)/V - 1)², V a body's mean volume."""

    names = ("volume_kept",)

    def __init__(self, weight: float, start: MovingSurfaces, times: np.ndarray) -> None:
        """times: [T] s, over which means are taken."""
        self._weight, self._faces, self._body, self._count = weight, start.faces, start.of_body, start.count
        self._weights = torch.from_numpy(start.basis.weights(times))
        self.resolved = {"volume_kept": weight}

    def __call__(self, model: Model, batch: Batch) -> Sequence[Part]:
        """The one part."""
        paths = model.parameters()[COEFFICIENTS]
        volumes = torch.stack([self._volumes(torch.einsum("k,kpx->px", w, paths)) for w in self._weights])
        change = volumes / volumes.mean(0) - 1
        return [Part("volume_kept", self._weight, change.square().mean(0).sum())]

    def _volumes(self, vertices: Tensor) -> Tensor:
        """[B] of all bodies, about the middle of all vertices."""
        a, b, c = (vertices - vertices.detach().mean(0))[self._faces].unbind(1)
        parts = (a * torch.linalg.cross(b, c)).sum(1) / 6
        return vertices.new_zeros(self._count).index_add(0, self._body, parts)


def square_root(gram: np.ndarray) -> np.ndarray:
    """R [K, K] with Rᵀ R = `gram` [K, K], positive semi-definite."""
    values, axes = np.linalg.eigh(gram)
    return np.sqrt(np.maximum(values, 0))[:, None] * axes.T
