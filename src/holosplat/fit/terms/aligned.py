"""Data terms of a pixel-aligned field beside its total variation, for both of which its voxels are evaluated once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from torch import Tensor

from ...geometry import Views
from ...model import Model
from ...representations import PixelAlignedField, VoxelGrid
from ..batch import Batch
from ..problem import Part
from ..total_variation import total_variation
from .frames import FrameTerm


class AlignedFrames:
    """The parts of a data term, and ∫ |∇u| of the field's voxels [voxel edges²], smoothed below `smoothing`."""

    def __init__(self, frames: FrameTerm, weight: float, smoothing: float) -> None:
        self._frames, self._weight, self._smoothing = frames, weight, smoothing
        self.names = (*frames.names, "variation")
        self.resolved = {**frames.resolved, "variation": weight}

    def __call__(self, model: Model, batch: Batch) -> Sequence[Part]:
        """The parts of the data term, and the variation."""
        voxels = _voxels(model)
        seen = self._frames(replace(model, object=voxels), batch)
        return [*seen, Part("variation", self._weight, _variation(voxels.values, self._smoothing))]


class AlignedLines:
    """½ Σ of squared differences from retrieved thickness over all pixels [pixels²], mean over views, and ∫ |∇u|.

    target: [V, H, W] in pixels of one material, on the pixels of `views`. No waves.
    """

    names = ("thickness", "variation")

    def __init__(self, target: Tensor, views: Views, weight: float, smoothing: float) -> None:
        self._target, self._views, self._weight, self._smoothing = target, views, weight, smoothing
        self.resolved = {"variation": weight}

    def __call__(self, model: Model, batch: Batch) -> Sequence[Part]:
        """Both parts."""
        voxels, target = _voxels(model), self._target
        views = self._views if batch.index is None else self._views[batch.index.numpy()]
        lines = voxels.project(views).channels[:, 0] / self._views.finest
        missing = lines - (target if batch.index is None else target[batch.index])
        return [
            Part("thickness", 1.0, 0.5 * missing.square().sum((1, 2)).mean()),
            Part("variation", self._weight, _variation(voxels.values, self._smoothing)),
        ]


def _voxels(model: Model) -> VoxelGrid:
    assert isinstance(model.object, PixelAlignedField)
    return model.object.at(0.0)


def _variation(values: Tensor, smoothing: float) -> Tensor:
    return total_variation(values, smoothing, "cpu") * values.numel()
