"""Training of pixel-aligned networks on frames alone, and how they do on scenes of another seed."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
import torch
from torch import Tensor, nn

from ..learning.aligned_weights import write_aligned
from ..learning.weights import Card
from ..representations import AlignedNetwork, PixelAligned, VoxelGrid
from .aligned_shown import aligned_lesson, first_views
from .critic import Critic
from .folder import Dataset
from .objective import share_of_overlap
from .options import TrainOptions
from .sample import Sample
from .train import BETAS, PURPOSE, Training
from .validate import Validation

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
        lesson = aligned_lesson(sample, self.options.shown, goal.targets, self.options.network, rng)
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
    """How well frames that are held out are foretold, and (for us, the network never sees it) the Dice coefficient."""

    columns: ClassVar[tuple[str, ...]] = ("step", "views", "misfit", "dice")

    network: Literal["onix", "pixelnerf"] = "onix"
    size: AlignedNetwork = DEFAULT

    def _scores(self, network: nn.Module, sample: Sample, count: int) -> tuple[float, float, float]:
        """Misfit of the frames held out, Dice coefficient, and the misfit again as what is left unexplained."""
        lesson = first_views(sample, count, self.network).on(str(next(network.parameters()).device))
        with torch.no_grad():
            voxels = lesson.field(dict(network.named_parameters()), self.size).at(0.0)
            misfit = float(lesson.misfit(voxels))
        return misfit, _overlap(voxels, sample), misfit


def _overlap(voxels: VoxelGrid, sample: Sample) -> float:
    return share_of_overlap(voxels.values[0].cpu() > 0.5, torch.from_numpy(sample.occupancy) > 127)
