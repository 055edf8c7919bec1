"""A discriminator of frames: whether an image is a measured one (Goodfellow et al. 2014; Zhang et al. 2025)."""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn.functional import leaky_relu, softplus

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
