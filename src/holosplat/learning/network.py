"""A network that guesses where matter is, from few views: images are encoded, lifted along their rays, and completed.

Each view is encoded by itself with the same weights (a small U-Net). The features are lifted along the rays into a
lattice (parallel beams), where mean, maximum and variance over views stand for any number of views, in any order. A 3D
U-Net turns them into occupancy on voxels half as large. What that predicts for the frames' thickness is compared with
them, the differences are lifted in turn, and a second U-Net corrects the guess: a learned primal-dual scheme (Adler &
Öktem 2018) of two steps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, avg_pool3d, interpolate

from ..checks import at_least, require
from ..ranges import Natural, ranged
from .lattice import Taps

MOST_LEVELS = 10
"""Levels of a U-Net, at most: the coarsest of eleven is of one pixel where the finest has a thousand."""


@dataclass(frozen=True)
@ranged
class Size:
    """How large a network is; about a million weights by default."""

    image: tuple[Natural, ...] = (16, 24, 32, 32)
    """Channels of the views' encoder, from its finest level to its coarsest."""
    features: int = 12
    """Channels that are lifted along the rays, of each view."""
    volume: tuple[Natural, ...] = (16, 40, 80)
    """Channels of the volumes' U-Nets, from the finest level to the coarsest."""

    def __post_init__(self) -> None:
        at_least(self, 1, "features")
        for name in ("image", "volume"):
            require_levels(name, getattr(self, name))


def require_levels(name: str, widths: Sequence[int]) -> None:
    """`InputError` unless a U-Net has as many levels as images and volumes can be halved."""
    count = len(widths)
    require(2 <= count <= MOST_LEVELS, f"{name} must have 2 to {MOST_LEVELS} levels, but it has {count}.")


FINE = 2
"""Voxels of the answer along the edge of one of the lattice, which has the images' pixels as its voxels."""
DEFAULT = Size()
INPUTS = 3
"""Channels of an image: contrast of the hologram, retrieved thickness, its noise."""
THICKNESS = 0.25
"""Of a pixel's length of matter, in the images: thickness is then of order one."""
SLOPE = 0.1
"""Of the leaky rectifiers."""


def _rectified(module: nn.Module) -> nn.Sequential:
    return nn.Sequential(module, nn.LeakyReLU(SLOPE))


class Images(nn.Module):
    """The encoder of single views: a U-Net whose answer is on pixels twice as large."""

    def __init__(self, size: Size) -> None:
        super().__init__()
        widths = size.image
        self.first = _rectified(nn.Conv2d(INPUTS, widths[0], 3, padding=1))
        self.down = nn.ModuleList(
            nn.Sequential(
                _rectified(nn.Conv2d(a, b, 4, stride=2, padding=1)), _rectified(nn.Conv2d(b, b, 3, padding=1))
            )
            for a, b in pairwise(widths)
        )
        self.up = nn.ModuleList(_rectified(nn.Conv2d(a + b, a, 3, padding=1)) for a, b in pairwise(widths[1:]))
        self.last = nn.Conv2d(widths[1], size.features, 1)

    def forward(self, images: Tensor) -> Tensor:
        """Features [V, F, H/2, W/2] of images [V, C, H, W]."""
        levels, found = [], self.first(images)
        for down in self.down:
            found = down(found)
            levels.append(found)
        for level, up in zip(levels[-2::-1], reversed(list(self.up))):
            found = up(torch.cat([level, _as_large(found, level)], 1))
        return self.last(found)


class Volumes(nn.Module):
    """A U-Net of volumes."""

    def __init__(self, inputs: int, outputs: int, widths: tuple[int, ...]) -> None:
        super().__init__()
        self.first = nn.Sequential(_rectified(nn.Conv3d(inputs, widths[0], 1)), _block(widths[0], widths[0]))
        self.down = nn.ModuleList(
            nn.Sequential(_rectified(nn.Conv3d(a, b, 2, stride=2)), _block(b, b), _block(b, b))
            for a, b in pairwise(widths)
        )
        self.up = nn.ModuleList(nn.Conv3d(b, a, 1) for a, b in pairwise(widths))
        self.mix = nn.ModuleList(_block(a, a) for a in widths[:-1])
        self.last = nn.Conv3d(widths[0], outputs, 1)

    def forward(self, volume: Tensor) -> Tensor:
        """[1, outputs, Z, Y, X] of [1, inputs, Z, Y, X]."""
        found = self.first(volume)
        levels = [found]
        for down in self.down:
            found = down(_even(found))
            levels.append(found)
        for level, up, mix in list(zip(levels, self.up, self.mix))[::-1]:
            found = mix(level + _as_large(up(found), level))
        return self.last(found)


class Guess(nn.Module):
    """The whole network: images of some views and where voxels lie in them → logits of occupancy, twice."""

    def __init__(self, size: Size = DEFAULT) -> None:
        super().__init__()
        self.size = size
        self.images = Images(size)
        lifted = 3 * size.features + 3
        self.guess = Volumes(lifted, FINE**3 + size.volume[0], size.volume)
        self.correct = Volumes(lifted + FINE**3 + size.volume[0] + 3, FINE**3, size.volume)

    def forward(self, images: Tensor, taps: Taps) -> tuple[Tensor, Tensor]:
        """Logits [2Z, 2Y, 2X] of the first guess and of the corrected one.

        images: [V, 3, 2H, 2W] (`learning.images`); taps: of the lattice
        [Z, Y, X] in images of half as many pixels.
        """
        thickness = avg_pool2d(images[:, 1:2], 2)
        seen = _over_views(taps.lift(self.images(images)), taps.lift(thickness))
        seen = seen.unflatten(1, taps.grid)[None]
        first = self.guess(seen)
        logits, state = first[:, : FINE**3], first[:, FINE**3 :]
        matter = torch.sigmoid(logits.float()).mean(1).flatten()
        missing = thickness[:, 0] - thickness_of(matter, taps)
        differences = _extremes(taps.lift(missing[:, None])).unflatten(1, taps.grid)[None]
        corrected = logits + self.correct(torch.cat([seen, logits, state, differences], 1))
        return _fine(logits), _fine(corrected)


def thickness_of(matter: Tensor, taps: Taps) -> Tensor:
    """What images [V, H, W] show of occupancy [N], as their channel of thickness does."""
    return THICKNESS * FINE * taps.project(matter)


def _over_views(features: Tensor, thickness: Tensor) -> Tensor:
    """[3F + 3, N]: mean, maximum and variance of features [V, F, N] over views, and the extremes of the thickness."""
    mean = features.mean(0)
    variance = (features - mean).square().mean(0)
    return torch.cat([mean, features.amax(0), variance, _extremes(thickness)])


def _extremes(values: Tensor) -> Tensor:
    """[3, N]: the least, mean and largest of values [V, 1, N] over views."""
    return torch.cat([values.amin(0), values.mean(0), values.amax(0)])


def _fine(logits: Tensor) -> Tensor:
    """Voxels [2Z, 2Y, 2X] of the eight channels of [1, 8, Z, Y, X]."""
    z, y, x = logits.shape[2:]
    parts = logits.reshape(FINE, FINE, FINE, z, y, x)
    return parts.permute(3, 0, 4, 1, 5, 2).reshape(FINE * z, FINE * y, FINE * x)


def coarse(volume: Tensor) -> Tensor:
    """The means [Z, Y, X] of eight voxels each of a volume [2Z, 2Y, 2X]."""
    return avg_pool3d(volume[None, None], FINE)[0, 0]


def _block(inputs: int, outputs: int) -> nn.Sequential:
    return _rectified(nn.Conv3d(inputs, outputs, 3, padding=1))


def _as_large(values: Tensor, as_: Tensor) -> Tensor:
    return interpolate(values, as_.shape[2:], mode="nearest")


def _even(values: Tensor) -> Tensor:
    """A volume with its last planes again where their number is odd."""
    odd = [extent % 2 for extent in values.shape[2:]]
    if not any(odd):
        return values
    return nn.functional.pad(values, (0, odd[2], 0, odd[1], 0, odd[0]), mode="replicate")
