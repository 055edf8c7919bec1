"""The options of learning: the ranges that scenes are drawn from, and how a network is trained on them."""

from __future__ import annotations

import math
from dataclasses import field
from typing import Annotated, Literal

from holosplat.checks import require
from holosplat.geometry import Views
from holosplat.learning.network import Size
from holosplat.ranges import (
    MOST,
    Angle,
    Many,
    Natural,
    Pixels,
    Positive,
    Rate,
    Seed,
    Share,
    SomeShare,
    Weight,
    Within,
    checked_dataclass,
)
from holosplat.scan import Exposures
from holosplat.units import wavelength

Kind = Literal["red-cells", "crowd", "ellipsoids", "capsules", "filled-capsules", "foam", "soft-cells"]
"""What a scene may be made of."""


@checked_dataclass
class Ranges:
    """Ranges (least, most) that scenes are drawn from; lengths of bodies are in pixels, so that scenes of any
    magnification are the same to a network."""

    kinds: tuple[Kind, ...] = ("red-cells",)
    """What scenes are made of, each kind as often as the others; crowd: red cells as close as they can be; capsules:
    shells about nothing; filled-capsules: about another material; soft-cells: continuous, with nuclei and vacuoles."""
    rows: Annotated[int, Within(16, MOST)] = 80
    """Of a frame [pixels]."""
    columns: Annotated[int, Within(16, MOST)] = 80
    """Of a frame [pixels]."""
    views: Annotated[int, Within(2, 10**5)] = 6
    """Frames with noise, for training."""
    held_out: Many = 2
    """Frames without noise, which show how well others are predicted."""
    tilted: Share = 0.2
    """Share of scenes whose views have no common axis."""
    tilt: Angle = 40.0
    """Tilt of these beams out of the plane, at most [degrees]."""
    across: tuple[Positive, Positive] = (10.0, 22.0)
    """Diameter of a body [pixels], evenly."""
    filled: tuple[SomeShare, SomeShare] = (0.01, 0.15)
    """Share of the room that bodies fill, evenly in its logarithm."""
    crowded: tuple[SomeShare, SomeShare] = (0.15, 0.22)
    """Share of the room that a crowd fills, evenly."""
    core: tuple[Share, Share] = (0.2, 0.8)
    """δ inside filled capsules over that of their shells, of the same δ/β, evenly."""
    medium: Share = 0.0
    """Share of scenes whose bodies lie in a medium that absorbs more than they do, as red cells in plasma: δ/β is then
    negative."""
    deform: tuple[Share, Share] = (0.0, 0.08)
    """Bending of red cells [diameters], evenly."""
    stretch: tuple[Share, Share] = (0.0, 0.35)
    """Stretch of red cells in flow, evenly in the logarithm of the lengths."""
    energy_kev: tuple[Positive, Positive] = (8.0, 30.0)
    """Photon energy [keV], evenly in its logarithm."""
    fresnel: tuple[Positive, Positive] = (0.02, 0.6)
    """Fresnel number of a pixel, p²/λz, evenly in its logarithm."""
    phase: tuple[Positive, Positive] = (0.02, 0.8)
    """Phase of a body's largest thickness [radians], evenly in its logarithm."""
    ratio: tuple[Positive, Positive] = (300.0, 4000.0)
    """δ/β of the matter, evenly in its logarithm."""
    noise: tuple[Positive, Positive] = (0.01, 0.2)
    """Standard deviation of the noise [radians] over that phase, evenly in its logarithm: the frames' contrast is about
    a third of the phase, and what is far below the noise teaches nothing."""
    noiseless: Share = 0.4
    """Share of scenes whose frames have no noise."""
    blur_px: tuple[Pixels, Pixels] = (0.0, 0.7)
    """Standard deviation of the point-spread function [pixels], evenly."""
    uneven: tuple[Weight, Weight] = (0.0, 0.0)
    """Smooth deviation of the light of every frame (rms), evenly; none by default."""
    misaligned_px: tuple[Pixels, Pixels] = (0.0, 0.0)
    """Standard deviation of unknown shifts of each view [pixels], evenly; none by default."""

    def __post_init__(self) -> None:
        require(len(self.kinds) > 0, "kinds must name at least one kind of specimen, but it is empty; give one.")
        for name, pair in vars(self).items():
            if name != "kinds" and isinstance(pair, tuple):
                require(pair[0] <= pair[1], f"{name} must be (least, most), but it is {pair}; exchange them.")

    def extremes(self) -> list[Exposures]:
        """Frames of both ends of the Fresnel numbers, between which those of all scenes lie."""
        pixel, energy = 1e-6, 20.0  # on which nothing depends beside the Fresnel number
        views = Views.evenly_spaced(self.views + self.held_out, (self.rows, self.columns), pixel)
        return [Exposures.of(views, energy, pixel**2 / (wavelength(energy) * number)) for number in self.fresnel]


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
    network: str = "start"
    """What is trained: the network of `--start learned`, or those of the methods `onix` and `pixelnerf`, which learn
    from frames alone, or that of `forecast --by graph`, on series of grow; these are of one size."""
    frames: FrameLossWeights = field(default_factory=FrameLossWeights)
    """The training loss of networks that learn from frames alone."""

    def rate_at(self, step: int) -> float:
        """The rate of the step number `step`, from 0."""
        left = 0.5 * (1 + math.cos(math.pi * min(1.0, step / self.steps)))
        return self.rate * min(1.0, (step + 1) / self.warm_up) * (left + (1 - left) * self.least_rate)
