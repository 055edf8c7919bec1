"""Still light: what all frames have in common in the same pixels, where their air shows that the light does it."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from scipy.ndimage import gaussian_filter
from torch import Tensor

from .air import WINDOW
from .background import FAINTEST
from .modes import smooth_modes
from .noise_model import NoiseModel

DARKEST = 0.01
"""Relative intensity below which a pixel counts as so bright: its logarithm has no meaning."""
SURE = 6.0
"""Standard errors by which frames must have something in common, in pixels in which they show air, or it is chance."""
MATTER = 0.5
"""Part of what air has in common that a volume may explain: light has it from no matter, whereas faint matter that
single frames hide in their noise passes for air, and of many frames surely has something in common."""
NOISELESS = 0.02
"""Frames count as having at least so much noise, as a share of their contrast: what less of it leaves is not light."""


@dataclass(frozen=True)
class Common:
    """What images have in common. power: its mean square; error: of that by chance; own: mean square of what each has
    alone."""

    power: float
    error: float
    own: float

    @classmethod
    def of(cls, values: Tensor, seen: Tensor, noise: NoiseModel | None = None) -> Common:
        """Of images [V, H, W], float64, where they are seen [V, H, W] bool: the mean product of two different ones.

        noise: of the images, whose correlation makes chance larger. Without a pixel that two images show, all are zero.
        """
        held, count = torch.where(seen, values, 0.0), seen.double().sum(dim=0)
        squares = held.square().sum(dim=0)
        pairs = float((count * (count - 1)).sum())
        if pairs == 0:
            return cls(0.0, 0.0, 0.0)
        power = float((held.sum(dim=0).square() - squares).sum()) / pairs
        own = max(float(squares.sum() / count.sum()) - power, 0.0)
        spectrum = None if noise is None else noise.power().mean(dim=0)
        alike = 1.0 if spectrum is None else float(spectrum.square().mean() / spectrum.mean().square().clamp_min(1e-60))
        return cls(power, own * (2 * alike / pairs) ** 0.5, own)


def shows_still_light(frames: Tensor, air: Tensor, noise: NoiseModel) -> bool:
    """Whether frames [V, H, W], in even light of their own, have light in common: by their air [V, H, W] bool.

    They must surely have something in common, and more than their noise leaves in the mean of all of them.
    """
    return _worth(Common.of(_logarithms(frames), air & (frames > DARKEST), noise), frames)


def still_light(frames: Tensor, predicted: Tensor, air: Tensor, noise: NoiseModel) -> Tensor | None:
    """The factor [H, W], float64, that frames [V, H, W] have in common beside those `predicted`; None without one.

    There is none, either, where the prediction explains what air has in common (`MATTER`): that is matter. Where frames
    show air [V, H, W] bool they say it themselves, elsewhere what is left of the prediction does, trusted by how little
    that is thereabouts. The light is expected to be as strong everywhere as air shows it (a Wiener filter of single
    pixels): matter that the prediction lacks in all frames, in the same pixels, cannot pass for more.
    """
    bright = (frames > DARKEST) & (predicted > DARKEST)
    left, seen = _logarithms(frames) - _logarithms(predicted), air & bright
    shown = Common.of(left, seen, noise)
    if not _worth(shown, frames) or shown.power < (1 - MATTER) * Common.of(_logarithms(frames), seen).power:
        return None
    beside = bright & ~air
    alone = max(shown.own, FAINTEST**2)
    squares, share = (_around(part.sum(dim=0)) for part in (torch.where(beside, left, 0.0).square(), beside.double()))
    trust = 1 / (squares / share.clamp_min(1e-6) - shown.power).clamp_min(alone)
    known = seen.sum(dim=0) / alone + beside.sum(dim=0) * trust
    said = torch.where(seen, _logarithms(frames), 0.0).sum(dim=0) / alone
    said += torch.where(beside, left, 0.0).sum(dim=0) * trust
    return (said / (known + 1 / shown.power)).exp()


def mean_light(frames: Tensor, predicted: Tensor, order: int) -> Tensor:
    """The geometric mean [H, W], float64, of frames [V, H, W] over those `predicted`: of up to `order` half waves, with
    its mean taken to be right, or any pattern (0)."""
    mean = (_logarithms(frames) - _logarithms(predicted)).mean(dim=0)
    if order:
        modes = smooth_modes((mean.shape[0], mean.shape[1]), order)[1:].flatten(1).double()
        mean = (torch.linalg.lstsq(modes.T, mean.flatten()[:, None]).solution[:, 0] @ modes).reshape(mean.shape)
    return mean.exp()


def _worth(found: Common, frames: Tensor) -> bool:
    contrast = (frames.double() - 1).square().mean()
    noise = max(found.own, FAINTEST**2, NOISELESS**2 * float(contrast))
    return found.power > SURE * found.error and found.power * len(frames) > noise


def _around(image: Tensor) -> Tensor:
    """The mean of an image [H, W] around each pixel, in a window of `WINDOW`."""
    return torch.from_numpy(gaussian_filter(image.numpy(), WINDOW, mode="nearest"))


def _logarithms(frames: Tensor) -> Tensor:
    return frames.double().clamp_min(DARKEST).log()
