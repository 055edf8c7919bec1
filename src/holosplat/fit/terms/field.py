"""Terms on neural fields and pixel-aligned networks: total variation, thickness, frames and line integrals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn.functional import normalize

from ...geometry import Views
from ...model import Model
from ...representations import NeuralField, PixelAlignedField, VoxelGrid
from ...representations.neural_field import Samples, uniform
from ..problem import FIXED, Batch, LossPart
from ..total_variation import total_variation
from .frames import FrameTerm

APART = 0.5
"""Distance [voxel edges] of the two points between which a field's variation is measured."""


class FieldVariation:
    """∫ |∇u| over the field's mask [voxel edges²], from differences along random directions: E |∇u · e| = |∇u| / 2."""

    names = ("variation",)

    def __init__(self, weight: float, probes: int, generator: torch.Generator) -> None:
        """probes: pairs of points a step."""
        self._weight, self._probes, self._generator = weight, probes, generator
        self.resolved = {"variation": weight}

    def __call__(self, model: Model, batch: Batch) -> Sequence[LossPart]:
        """The one part."""
        field, generator = model.object, self._generator
        assert isinstance(field, NeuralField)
        cells = field.mask.nonzero().flip(1)
        chosen = (uniform(generator, self._probes) * len(cells)).long()
        at = cells[chosen] + uniform(generator, self._probes, 3)
        along = torch.randn(self._probes, 3, generator=generator, device=at.device)
        first, second = field(torch.cat((at, at + APART * normalize(along, dim=1)))).split(self._probes)
        total = (second - first).abs().mean(dim=0).sum() * (2 * len(cells) / APART)
        return [LossPart("variation", self._weight, total)]


class RetrievedThickness:
    """Σ of squared differences from retrieved thickness over all pixels [voxel edges²], mean over views.

    target: [V, H, W] in voxel edges; share: of the pixels that a step looks at, drawn anew each time.
    """

    names = ("thickness",)
    resolved = FIXED

    def __init__(self, target: Tensor, views: Views, share: float, generator: torch.Generator) -> None:
        self._target, self._views, self._share, self._generator = target, views, share, generator

    def __call__(self, model: Model, batch: Batch) -> Sequence[LossPart]:
        """The one part."""
        field = model.object
        assert isinstance(field, NeuralField)
        total = sum((self._view(field, v) for v in range(len(self._views))), start=self._target.new_zeros(()))
        return [LossPart("thickness", 1.0, total / (self._share * len(self._views)))]

    def _view(self, field: NeuralField, v: int) -> Tensor:
        chosen = uniform(self._generator, self._target[v].numel()) < self._share
        every = field.kept_samples(self._views, v)
        kept = chosen[every.pixel]
        rays = Samples(every.pixel[kept], every.depth[kept])
        found = field.thickness(self._views, v, rays, uniform(self._generator, len(rays.pixel)))[0].flatten()
        return (found - self._target[v].flatten())[chosen].square().sum()


class AlignedFrames:
    """The parts of a data term, and ∫ |∇u| of the field's voxels [voxel edges²], smoothed below `smoothing`."""

    def __init__(self, frames: FrameTerm, weight: float, smoothing: float) -> None:
        self._frames, self._weight, self._smoothing = frames, weight, smoothing
        self.names = (*frames.names, "variation")
        self.resolved = {**frames.resolved, "variation": weight}

    def __call__(self, model: Model, batch: Batch) -> Sequence[LossPart]:
        """The parts of the data term, and the variation."""
        voxels = _voxels(model)
        seen = self._frames(replace(model, object=voxels), batch)
        return [*seen, LossPart("variation", self._weight, _variation(voxels.values, self._smoothing))]


class AlignedLines:
    """½ Σ of squared differences from retrieved thickness over all pixels [pixels²], mean over views, and ∫ |∇u|.

    target: [V, H, W] in pixels of one material, on the pixels of `views`. No waves.
    """

    names = ("thickness", "variation")

    def __init__(self, target: Tensor, views: Views, weight: float, smoothing: float) -> None:
        self._target, self._views, self._weight, self._smoothing = target, views, weight, smoothing
        self.resolved = {"variation": weight}

    def __call__(self, model: Model, batch: Batch) -> Sequence[LossPart]:
        """Both parts."""
        voxels, target = _voxels(model), self._target
        views = self._views if batch.index is None else self._views[batch.index.numpy()]
        lines = voxels.project(views).channels[:, 0] / self._views.finest
        missing = lines - (target if batch.index is None else target[batch.index])
        return [
            LossPart("thickness", 1.0, 0.5 * missing.square().sum((1, 2)).mean()),
            LossPart("variation", self._weight, _variation(voxels.values, self._smoothing)),
        ]


def _voxels(model: Model) -> VoxelGrid:
    assert isinstance(model.object, PixelAlignedField)
    return model.object.at(0.0)


def _variation(values: Tensor, smoothing: float) -> Tensor:
    return total_variation(values, smoothing, "cpu") * values.numel()
