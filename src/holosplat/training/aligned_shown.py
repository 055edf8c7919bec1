"""Input and target frames of a pixel-aligned network in one step, without volumes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from ..checks import InputError
from ..geometry import Grid, Views, rotation_y
from ..learning.aligned_weights import ONIX
from ..learning.images import images
from ..matter import Matter
from ..methods.neural_field import visual_hull
from ..methods.onix import AlignedFit
from ..model import Instrument, Model
from ..optics.sampling import fringe_sampling
from ..representations import AlignedNetwork, PixelAlignedField, VoxelGrid
from ..representations.neural_field import grown
from ..scan import Exposures
from .as_scan import SampleScan, as_scan
from .options import Shown
from .sample import Sample

FIT = AlignedFit()
"""The field lives where that of a reconstruction does."""


@dataclass(frozen=True)
class AlignedLesson:
    """scene: all frames of a sample; noise: [N], of these; seen: those that the network is shown; targets: those that
    it should predict; network: `onix` or `pixelnerf`; device: where the network is, and all is compared."""

    scene: SampleScan
    noise: np.ndarray
    seen: np.ndarray
    targets: np.ndarray
    network: str
    device: str = "cpu"

    def on(self, device: str) -> AlignedLesson:
        """The same on a device."""
        return replace(self, device=device)

    @cached_property
    def rms(self) -> float:
        """Of the contrast of the frames that are shown."""
        shown = self.scene.scan.frames[self.seen] - 1
        return max(float(np.sqrt(np.mean(shown**2))), float(np.finfo(np.float16).tiny))

    def field(self, weights: Mapping[str, Tensor], size: AlignedNetwork) -> PixelAlignedField:
        """Output of the network on the scene; where the views agree on nothing, it is evaluated everywhere."""
        scan, material = self.scene.scan[self.seen], self.scene.material
        thickness = torch.from_numpy(self.scene.thickness[self.seen]) / scan.views.finest
        shown = images(torch.from_numpy(scan.frames) - 1, thickness, torch.from_numpy(self.noise[self.seen]))
        grid = Grid.of_views(scan.views)
        try:
            mask = grown(visual_hull(thickness, scan.views, grid, FIT.hull), FIT.margin)
        except InputError:
            mask = torch.ones(grid.shape, dtype=torch.bool)
        field = PixelAlignedField(
            weights, shown.to(self.device), scan.views, mask, grid, Matter.one(*material), network=size
        )
        return field.with_parameters(weights)

    def misfit(self, voxels: VoxelGrid, which: np.ndarray | None = None) -> Tensor:
        """Mean square difference [] of predicted frames (default: the targets), over that of their contrast; without
        waves, of thickness over that of the retrieved one."""
        chosen = self.targets if which is None else which
        if self.network == ONIX:
            measured = self._here(self.scene.scan.frames[chosen])
            return (self._frames(voxels, self.scene.scan.exposures[chosen]) - measured).square().mean() / self.rms**2
        wanted = self._here(self.scene.thickness[chosen])
        lines = voxels.project(self.scene.scan.views[chosen]).channels[:, 0]
        return (lines - wanted).square().mean() / wanted.square().mean().clamp_min(1e-30)

    def unseen(self, voxels: VoxelGrid, angle: float) -> Tensor:
        """A predicted image [1, 1, H, W] in a direction about y without a frame [radians], in units of contrast."""
        exposures = self.scene.scan.exposures[self.seen[:1]]
        views = exposures.views
        turned = Views(rotation_y([float(np.degrees(angle))]), views.shifts, views.shape, views.pitch)
        frame = self._frames(voxels, replace(exposures, views=turned))
        return (frame - 1)[None] / self.rms

    def real(self) -> Tensor:
        """A measured one of those that are shown."""
        return self._here(self.scene.scan.frames[self.seen[:1]] - 1)[None] / self.rms

    def _here(self, images: np.ndarray) -> Tensor:
        return torch.from_numpy(images).to(self.device)

    def _frames(self, voxels: VoxelGrid, exposures: Exposures) -> Tensor:
        return Model(voxels, Instrument(exposures, fringe_sampling(exposures), backend=voxels.backend)).frames()


def aligned_lesson(sample: Sample, how: Shown, targets: int, network: str, rng: np.random.Generator) -> AlignedLesson:
    """`sample` as it is shown once: some of its views, and others that are to be foretold."""
    training = np.flatnonzero(~sample.is_test)
    count = min(int(rng.choice(how.views)), len(training))
    order = rng.permutation(training)
    seen, rest = order[:count], np.concatenate([order[count:], np.flatnonzero(sample.is_test)])
    new = rng.permutation(rest)[: (targets + 1) // 2]
    old = rng.permutation(seen)[: targets - len(new)]
    return AlignedLesson(as_scan(sample), sample.noise, seen, np.concatenate([new, old]), network)


def first_views(sample: Sample, count: int, network: str) -> AlignedLesson:
    """The first `count` views for training, to foretell those that are held out."""
    training = np.flatnonzero(~sample.is_test)
    rest = np.concatenate([np.flatnonzero(sample.is_test), training[count:]])
    return AlignedLesson(as_scan(sample), sample.noise, training[:count], rest, network)
