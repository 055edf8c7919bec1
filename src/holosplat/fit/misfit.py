"""The objective as a function of the cloud: what one step of a fit differentiates."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ..geometry import Grid, Poses
from ..model.instrument import Instrument
from ..optics.detector import blur
from ..optics.noise import noise_share, sure_noise
from ..representations.gaussians import GaussianCloud
from ..scan import Scan
from . import objective as terms
from .fidelity import Target, l1_and_ssim
from .objective import Objective
from .total_variation import total_variation

IMAGE_TERMS = ("l1", "l2_amplitude", "ssim", "tv_image", "frc")
OBJECT_TERMS = ("anisotropy", "tv_volume", "overfull", "two_levels")
DARK = 0.05
"""Relative intensity below which noise falls no further."""
DEPTH, VIEWS = 100.0, 8.0
"""Voxels along the beam, and views, for which the weights of the terms on the volume are meant. Few views leave more
to what is known of the volume; the weights go with one over the root of their number."""
COARSEST_NOISE = 0.5
"""Noise, as a share of the frames' contrast, from which on frames are blurred by all of `Objective.coarse` at first."""
LEAST_BLUR = 0.1
"""Pixels below which a blur changes nothing, and is left out."""


@dataclass(frozen=True)
class Draw:
    """What one step looks at. The tensors live on the fit's device, where a captured step reads them again.

    index: views [V] int64, or None for all of them in order; middle: centre [3] `(x, y, z)` [m] of the block of volume,
    float64; progress: share [] of the steps that are done; volume: weight of the terms on the volume, 0 where this
    step does not look at it.
    """

    index: Tensor | None
    middle: Tensor
    progress: Tensor
    volume: int


class Misfit:
    """The objective of a scan's frames on one device: `(cloud, draw)` in, loss and single terms out.

    Nothing in a call waits for the device, or depends on values that are not tensors there, but `draw.volume`.
    """

    def __init__(
        self,
        train: Scan,
        instrument: Instrument,
        objective: Objective,
        detach_worst: bool,
        block: Grid,
        depth: int,
    ) -> None:
        """`train`: the frames to fit; `block`: a grid of the shape and pitch at which the volume is looked at; `depth`:
        voxels of the whole volume along the beam."""
        self.objective, self.instrument, self._detach_worst = objective, instrument, detach_worst
        self.low, high = float(train.frames.min()), float(train.frames.max())
        self.span = high - self.low
        self._poses = Poses.of(instrument.views, instrument.device)
        measured = torch.from_numpy(train.frames)
        frames = measured.to(instrument.device)
        self._target = Target(frames, self.low, self.span, instrument.backend)
        if objective.ssim > 0:
            _ = self._target.statistics  # once, for all subsets of views
        self._block = (block.shape, block.voxel_size[0])
        self._volume_scale = depth / DEPTH * math.sqrt(VIEWS / len(train))
        noise = noise_share(measured)
        self._two_levels = objective.two_levels * (1 + objective.noise_gain * noise)
        coarse = objective.coarse * min(1.0, noise / COARSEST_NOISE)
        self._blur = NarrowingBlur(frames.shape[1:], coarse, frames.device) if coarse > LEAST_BLUR else None
        self._width = (objective.noise_width * photon_noise(measured)).clamp_min(1e-6 * self.span).to(frames.device)

    def names(self, cloud: GaussianCloud, draw: Draw) -> list[str]:
        """What the values of a call with these arguments are called."""
        image = [name for name in IMAGE_TERMS if getattr(self.objective, name) > 0]
        return ["loss", *image, *self._object_weights(cloud, draw)]

    def __call__(self, cloud: GaussianCloud, draw: Draw) -> tuple[Tensor, Tensor]:
        """The loss, and the values [K] of `names(cloud, draw)`, detached."""
        poses = self._poses if draw.index is None else self._poses[draw.index]
        predicted = self.instrument.frames(cloud.project(poses), draw.index)
        parts = self._image_terms(predicted, draw)
        per_view = sum(weight * value for weight, value in parts.values())
        assert isinstance(per_view, Tensor)
        if self._detach_worst and len(per_view) > 1:
            per_view = torch.where(per_view > per_view.detach().median(), per_view.detach(), per_view)
        loss = per_view.mean()
        values = [value.detach().mean() for _, value in parts.values()]
        for weight, value in self._object_terms(cloud, draw):
            loss = loss + weight * value
            values.append(value.detach())
        return loss, torch.stack([loss.detach(), *values])

    def _image_terms(self, predicted: Tensor, draw: Draw) -> dict[str, tuple[float | Tensor, Tensor]]:
        """Weight and value [V] of every image term in use."""
        w, target = self.objective, self._target if draw.index is None else self._target[draw.index]
        if w.ssim > 0:
            difference, dissimilarity = l1_and_ssim(predicted, target)
        else:  # statistics of frames are not needed
            difference, dissimilarity = terms.l1(predicted, target.frames) / self.span, predicted
        if w.noise_width > 0 or self._blur:
            difference = self._beyond_noise(predicted, target.frames, draw) / self.span
        a, b = ((f - self.low) / self.span if w.tv_image + w.frc > 0 else f for f in (predicted, target.frames))
        table: list[tuple[str, float, Callable[[], Tensor]]] = [
            ("l1", w.l1, lambda: difference),
            ("l2_amplitude", w.l2_amplitude, lambda: terms.l2_amplitude(predicted, target.frames)),
            ("ssim", w.ssim, lambda: dissimilarity),
            ("tv_image", w.tv_image, lambda: terms.tv_image(a)),
            ("frc", w.frc, lambda: terms.one_minus_frcm(a, b)),
        ]
        ramps = {"frc": (draw.progress / max(w.frc_ramp, 1e-9)).clamp_max(1.0)}
        return {name: (weight * ramps.get(name, 1.0), value()) for name, weight, value in table if weight > 0}

    def _beyond_noise(self, predicted: Tensor, measured: Tensor, draw: Draw) -> Tensor:
        """Huber's function of the differences [V] of frames [V, H, W] that are as blurred as is due."""
        width = self._width if draw.index is None else self._width.index_select(0, draw.index)
        if self._blur:
            predicted, measured = (self._blur(frames, draw.progress) for frames in (predicted, measured))
        return terms.huber(predicted, measured, width)

    def _object_weights(self, cloud: GaussianCloud, draw: Draw) -> dict[str, float]:
        """Weight of every term on the Gaussians in use at this step, before it is ramped."""
        w, bounded = self.objective, draw.volume * cloud.occupancies
        table = {
            "anisotropy": w.anisotropy,
            "tv_volume": w.tv_volume * draw.volume,
            "overfull": w.overfull * bounded,
            "two_levels": self._two_levels * bounded,
        }
        return {name: weight for name, weight in table.items() if weight > 0}

    def _object_terms(self, cloud: GaussianCloud, draw: Draw) -> list[tuple[float | Tensor, Tensor]]:
        """Weight and value of every term on the Gaussians in use at this step."""
        weights, scale = self._object_weights(cloud, draw), self._volume_scale
        of_volume = any(name != "anisotropy" for name in weights)
        density = cloud.density_around(draw.middle, *self._block) if of_volume else draw.middle
        values: dict[str, Callable[[], Tensor]] = {
            "anisotropy": lambda: terms.anisotropy(cloud.log_scales, self.objective.anisotropy_limit),
            "tv_volume": lambda: scale * len(density) * total_variation(density, backend=cloud.backend),
            "overfull": lambda: scale * terms.overfull(density),
            "two_levels": lambda: scale * terms.two_levels(density),
        }
        ramps = {"two_levels": draw.progress}
        return [(weight * ramps.get(name, 1.0), values[name]()) for name, weight in weights.items()]


class NarrowingBlur:
    """A Gaussian blur of frames of `shape` whose standard deviation falls from `sigma` [pixels] to 0 during the fit."""

    def __init__(self, shape: Sequence[int], sigma: float, device: torch.device) -> None:
        rows, columns = torch.fft.fftfreq(shape[0]), torch.fft.rfftfreq(shape[1])
        self._exponent = (-2 * (math.pi * sigma) ** 2 * (rows[:, None] ** 2 + columns**2)).to(device)

    def __call__(self, frames: Tensor, progress: Tensor) -> Tensor:
        """Frames [V, H, W], blurred as is due when `progress` [] of the steps are done; periodic."""
        return blur(frames, torch.exp((1 - progress) ** 2 * self._exponent))


def photon_noise(frames: Tensor) -> Tensor:
    """Standard deviation of each pixel of relative frames [V, H, W] that photons make noisy.

    The frames' own noise is that of their quiet parts, where the intensity is about 1, and goes with its root.
    """
    return sure_noise(frames).to(frames)[:, None, None] * frames.clamp_min(DARK).sqrt()
