"""Light between pixel sizes: found on coarse frames, as hypotheses are compared, it is divided out of fine ones."""

from __future__ import annotations

from dataclasses import replace

from torch import Tensor
from torch.nn.functional import interpolate, pad

from .background import ORDER, Background, Light, LightOptions
from .noise_model import NoiseModel
from .patterns import smooth_modes


def binned_options(options: LightOptions, shape: tuple[int, int], factor: int) -> LightOptions:
    """`options` of frames of `shape` (H, W) for pixels `factor` times larger, as `Scan.binned` makes them: boxes of air
    hold the pixels that lie in them, or else the one about their middle."""
    if factor == 1 or not options.air:
        return options

    def side(first: int, end: int, count: int) -> tuple[int, int]:
        cut, few = (count % factor) // 2, count // factor
        start, stop = max(0, -((cut - first) // factor)), min((end - cut) // factor, few)
        middle = min(max(0, ((first + end) // 2 - cut) // factor), few - 1)
        return (start, stop) if start < stop else (middle, middle + 1)

    boxes = [(*side(top, bottom, shape[0]), *side(left, right, shape[1])) for top, bottom, left, right in options.air]
    return replace(options, air=tuple(boxes))


def finer_light(light: Light, frames: Tensor, factor: int) -> Light:
    """`light` of frames that were binned by `factor` out of `frames` [V, H, W], for these, in the same air.

    Their noise in even light is white: that it is correlated is a hypothesis of its own.
    """
    air, background, shape = light.air, light.background, (frames.shape[-2], frames.shape[-1])
    if factor > 1 and background is not None:
        air = _spread(air[:, None].double(), shape, factor, "nearest")[:, 0] > 0.5
        background = _finer(background, shape, factor)
    even = frames if background is None else frames / background.factor()
    return Light(air, NoiseModel.of_frames(even, air), background)


def _finer(known: Background, shape: tuple[int, int], factor: int) -> Background:
    """The modes of the coarse frames between their pixels, as modes of the fine ones, as `Background.binned` does."""
    fine = smooth_modes(shape, ORDER).double().flatten(1)
    old = _spread(smooth_modes(known.shape, ORDER).double()[None], shape, factor, "bicubic")[0].flatten(1)
    change = fine @ old.T / old.shape[1]
    covariances = change @ known.covariances @ change.T
    return Background(known.coefficients @ change.T, covariances, known.variances, known.powers * factor**2, shape)


def _spread(images: Tensor, shape: tuple[int, int], factor: int, how: str) -> Tensor:
    """Images [N, C, h, w] on pixels `factor` times smaller, out to the rows and columns that binning cut."""
    wide = interpolate(images, scale_factor=factor, mode=how)
    (top, bottom), (left, right) = (
        ((n % factor) // 2, n - few - (n % factor) // 2) for n, few in zip(shape, wide.shape[-2:])
    )
    return pad(wide, (left, right, top, bottom), mode="replicate")
