"""Options of a training."""

from __future__ import annotations

import math
from dataclasses import field
from typing import Literal

from ..checks import at_least
from ..learning.network import Size
from ..ranges import Natural, Positive, Rate, Seed, Share, Weight, checked_dataclass


@checked_dataclass
class FrameLossWeights:
    """The training loss of networks that learn from frames alone, without volumes."""

    targets: Natural = 2
    """Frames that each step predicts; half of them, rounded up, are none of those that the network sees."""
    mse: Weight = 5.0
    """Of the mean square difference of frames, in that of their contrast (4D-ONIX: 5)."""
    adversary: Weight = 0.0
    """Of a discriminator that looks at frames in directions without one (4D-ONIX: 0.1; default: none)."""
    pretrain: Share = 0.5
    """Share of the steps before the discriminator begins."""
    adversary_rate: Weight = 1e-4
    """AdamW's rate of the discriminator (4D-ONIX: 1e-4)."""


@checked_dataclass
class ViewSampling:
    """How samples are shown, so that few scenes stand for many."""

    views: tuple[Natural, ...] = (2, 2, 2, 2, 3, 3, 3, 4, 5, 6)
    """Numbers of views, each as often as it stands here."""
    first_two: Share = 0.6
    """Share of pairs of views that are the first two, which are nearly at right angles in many scenes."""
    rows: tuple[Natural, ...] = (40, 48, 56)
    """Rows that are cut out, where views have a common axis: bodies then go on above and below, as in a flow."""


@checked_dataclass
class LossWeights:
    """Weights of what is minimised."""

    entropy: Weight = 20.0
    """Of the binary cross entropy of occupancy, a mean over voxels: most are empty, so that it is small."""
    dice: Weight = 1.0
    """Of one less the Dice coefficient (Milletari et al. 2016), which does not care how many are empty."""
    first: Weight = 0.5
    """Of the guess before its correction, over that of the corrected one."""


@checked_dataclass
class TrainOptions:
    """How a network is trained."""

    steps: Natural = 24_000
    """Steps, of one scene each; the weights of the package were made with 7000."""
    rate: Rate = 1.5e-3
    """Largest rate of AdamW; it falls to `least_rate` of it along half a cosine."""
    least_rate: Share = 0.03
    """Learning rate at the end, relative to the start."""
    warm_up: Natural = 100
    """Steps in which the rate rises."""
    decay: Weight = 1e-4
    """Weight decay (Loshchilov & Hutter 2019)."""
    longest: Positive = 1.0
    """Norm of a gradient, at most: longer ones are shortened."""
    keep_every: Natural = 500
    """Steps from one checkpoint and one validation to the next."""
    validation: Natural = 16
    """Scenes of another seed that validate."""
    precision: Literal["auto", "bfloat16", "float32"] = "auto"
    """Of the network's sums; auto: bfloat16 where the processor multiplies it, to save time."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where it is computed."""
    seed: Seed = 0
    """Of the first weights, and of what is shown when."""
    size: Size = field(default_factory=Size)
    """Of the network."""
    shown: ViewSampling = field(default_factory=ViewSampling)
    """How scenes are shown."""
    goal: LossWeights = field(default_factory=LossWeights)
    """The training loss."""
    network: Literal["start", "onix", "pixelnerf", "dynamics"] = "start"
    """What is trained: the network of `--start learned`, or those of the methods `onix` and `pixelnerf`, which learn
    from frames alone, or that of `forecast --by graph`, on series of grow; these are of one size."""
    frames: FrameLossWeights = field(default_factory=FrameLossWeights)
    """The training loss of networks that learn from frames alone."""

    def __post_init__(self) -> None:
        at_least(self, 1, "steps")

    def rate_at(self, step: int) -> float:
        """The rate of the step number `step`, from 0."""
        left = 0.5 * (1 + math.cos(math.pi * min(1.0, step / self.steps)))
        return self.rate * min(1.0, (step + 1) / self.warm_up) * (left + (1 - left) * self.least_rate)
