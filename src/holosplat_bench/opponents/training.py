"""Training of pixel-aligned networks on frames alone: examples, discriminator, training and validation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import leaky_relu, softplus

from holosplat.checks import InputError
from holosplat.geometry import Grid, Views, rotation_y
from holosplat.learning.start import Card, images
from holosplat.matter import Matter
from holosplat.model import Instrument, Model
from holosplat.optics.sampling import fringe_sampling
from holosplat.planning.needs import Needs
from holosplat.representations import VoxelGrid
from holosplat.scan import Exposures

from ..training.folder import Dataset
from ..training.options import TrainOptions, ViewSampling
from ..training.sample import Sample, SampleScan, as_scan
from ..training.shown import Validation, share_of_overlap
from ..training.train import BETAS, PURPOSE, Trainer, Training
from .fields import AlignedNetwork, PixelAligned, PixelAlignedField
from .fields.neural_field import grown
from .fields.weights import ONIX, PIXELNERF, write_aligned
from .neural_fields import visual_hull
from .onix import AlignedFit

FIT = AlignedFit()
"""The field lives where that of a reconstruction does."""


@dataclass(frozen=True)
class AlignedExample:
    """scene: all frames of a sample; noise: [N], of these; seen: those that the network is shown; targets: those that
    it should predict; network: `onix` or `pixelnerf`; device: where the network is, and all is compared."""

    scene: SampleScan
    noise: np.ndarray
    seen: np.ndarray
    targets: np.ndarray
    network: str
    device: str = "cpu"

    def on(self, device: str) -> AlignedExample:
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


def draw_aligned_example(
    sample: Sample, how: ViewSampling, targets: int, network: str, rng: np.random.Generator
) -> AlignedExample:
    """`sample` as it is shown once: some of its views, and others that are to be predicted."""
    training = np.flatnonzero(~sample.is_test)
    count = min(int(rng.choice(how.views)), len(training))
    order = rng.permutation(training)
    seen, rest = order[:count], np.concatenate([order[count:], np.flatnonzero(sample.is_test)])
    new = rng.permutation(rest)[: (targets + 1) // 2]
    old = rng.permutation(seen)[: targets - len(new)]
    return AlignedExample(as_scan(sample), sample.noise, seen, np.concatenate([new, old]), network)


def first_views(sample: Sample, count: int, network: str) -> AlignedExample:
    """The first `count` views for training, to foretell those that are held out."""
    training = np.flatnonzero(~sample.is_test)
    rest = np.concatenate([np.flatnonzero(sample.is_test), training[count:]])
    return AlignedExample(as_scan(sample), sample.noise, training[:count], rest, network)


WIDTHS = (1, 16, 32, 32)
"""Channels, each on pixels twice as large as the ones before: patches of 22 pixels are looked at."""
SLOPE = 0.2
"""Of the leaky rectifiers."""
FLATTER = 10.0
"""Weight of the squared slope at measured images (R₁ of Mescheder et al. 2018), which keeps it honest."""


class Critic(nn.Module):
    """Scores of the patches of an image: large where it looks measured."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.ModuleList(nn.Conv2d(a, b, 4, stride=2, padding=1) for a, b in pairwise(WIDTHS))
        self.last = nn.Conv2d(WIDTHS[-1], 1, 1)

    def forward(self, images: Tensor) -> Tensor:
        """[N, 1, h, w] of images [N, 1, H, W]."""
        for layer in self.layers:
            images = leaky_relu(layer(images), SLOPE)
        return self.last(images)

    def misled(self, made: Tensor) -> Tensor:
        """What a predicted image costs that does not look measured []."""
        return softplus(-self(made)).mean()

    def loss(self, made: Tensor, measured: Tensor) -> Tensor:
        """What the discriminator minimises []."""
        measured = measured.detach().requires_grad_()
        score = self(measured)
        (slope,) = torch.autograd.grad(score.sum(), measured, create_graph=True)
        honest = softplus(-score).mean() + softplus(self(made.detach())).mean()
        return honest + 0.5 * FLATTER * slope.square().sum() / score.numel()


DEFAULT = AlignedNetwork()
COLUMNS = ("step", "loss", "misfit", "misled", "rate")
DIRECTIONS = 2
"""Keeps directions that are drawn for the discriminator apart from other numbers of the same step."""


class AlignedTraining(Training):
    """A training of `onix` or `pixelnerf`: no volume is looked at, in no step."""

    columns: ClassVar[tuple[str, ...]] = COLUMNS

    def __init__(self, data: Dataset, folder: Path, options: TrainOptions, size: AlignedNetwork = DEFAULT) -> None:
        self.size = size
        super().__init__(data, folder, options)
        self.critic: Critic | None = None
        self._shown: tuple[Tensor, Tensor] | None = None
        if options.frames.adversary > 0:
            self.critic = Critic().to(options.device)
            self.judge = torch.optim.AdamW(self.critic.parameters(), options.frames.adversary_rate, betas=BETAS)

    def _made(self) -> nn.Module:
        return PixelAligned(self.size, self.options.seed)

    def parts(self) -> dict[str, Any]:
        """What a checkpoint holds, the discriminator too."""
        beside = {} if self.critic is None else {"critic": self.critic, "judge": self.judge}
        return super().parts() | beside

    def _value(self, sample: Sample, rng: np.random.Generator) -> tuple[Tensor, list[float]]:
        goal = self.options.frames
        lesson = draw_aligned_example(sample, self.options.shown, goal.targets, self.options.network, rng)
        lesson = lesson.on(self.options.device)
        voxels = lesson.field(dict(self.network.named_parameters()), self.size).at(0.0)
        misfit, misled = lesson.misfit(voxels), torch.zeros(())
        if self.critic is not None and self.step >= goal.pretrain * self.options.steps:
            drawn = np.random.default_rng([PURPOSE, DIRECTIONS, self.options.seed, self.step])
            made = lesson.unseen(voxels, float(drawn.uniform(0, np.pi)))
            misled = self.critic.misled(made)
            self._shown = made.detach(), lesson.real()
        return goal.mse * misfit + goal.adversary * misled, [float(misfit.detach()), float(misled.detach())]

    def advance(self) -> None:
        """One step of the network, and then of the discriminator, where there is one and it has been shown images."""
        super().advance()
        if self.critic is not None and self._shown is not None:
            self._teach(self.critic, *self._shown)
            self._shown = None

    def _teach(self, critic: Critic, made: Tensor, measured: Tensor) -> None:
        value = critic.loss(made, measured)
        self.judge.zero_grad()
        gradients = torch.autograd.grad(value, list(critic.parameters()))
        for parameter, gradient in zip(critic.parameters(), gradients):
            parameter.grad = gradient
        self.judge.step()

    def _write(self, path: Path, card: Card) -> None:
        write_aligned(path, self.options.network, self.size, dict(self.network.named_parameters()), card)


@dataclass
class AlignedValidation(Validation):
    """Errors of predicted held-out frames, and (for us, the network never sees it) the Dice coefficient."""

    columns: ClassVar[tuple[str, ...]] = ("step", "views", "misfit", "dice")

    network: str = ONIX
    size: AlignedNetwork = DEFAULT

    def _scores(self, network: nn.Module, sample: Sample, count: int) -> tuple[float, float, float]:
        """Misfit of the frames held out, Dice coefficient, and the misfit again as what is left unexplained."""
        lesson = first_views(sample, count, self.network).on(str(next(network.parameters()).device))
        with torch.no_grad():
            voxels = lesson.field(dict(network.named_parameters()), self.size).at(0.0)
            misfit = float(lesson.misfit(voxels))
        return misfit, share_of_overlap(voxels.values[0].cpu() > 0.5, torch.from_numpy(sample.occupancy) > 127), misfit


PROGRAM, VOXEL, VOXEL_IN_VIEW = 0.58e9, 120.0, 18.0
"""Bytes of memory of a training: the program with its optimiser, a voxel of the field, and a voxel in each view
(`benchmarks/needs_acts.py`)."""


def needs_of_training(shape: tuple[int, int], views: int, options: TrainOptions) -> Needs:
    """What a training takes for scenes of so many pixels and shown views."""
    voxels = shape[0] * shape[1] ** 2
    memory = PROGRAM + (VOXEL + VOXEL_IN_VIEW * views) * voxels
    return Needs(memory, 1e8, options.steps * (0.2 + 2e-5 * views * voxels))


ONIX_TRAINER, PIXELNERF_TRAINER = (
    Trainer(AlignedTraining, partial(AlignedValidation, network=network), needs_of_training)
    for network in (ONIX, PIXELNERF)
)
"""As `training.train.NETWORKS` has them."""
