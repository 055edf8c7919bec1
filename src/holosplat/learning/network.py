"""A network that guesses where matter is, from few views: images are encoded, lifted along their rays, and completed.

Each view is encoded by itself with the same weights (a small U-Net). The features are lifted along the rays into a
lattice (parallel beams), where mean, maximum and variance over views stand for any number of views, in any order. A 3D
U-Net turns them into occupancy on voxels half as large. What that predicts for the frames' thickness is compared with
them, the differences are lifted in turn, and a second U-Net corrects the guess: a learned primal-dual scheme (Adler &
Öktem 2018) of two steps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, product

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, avg_pool3d, interpolate

from ..checks import require
from ..geometry import Grid, Views
from ..ranges import Natural, checked_dataclass


@dataclass(frozen=True)
class Taps:
    """The four pixels around each voxel's shadow in each view.

    index: [V, N, 4] int64, numbers of pixels in a flat image; the image's last one and more where there is none
    weight: [V, N, 4] float32, bilinear weights; 0 beyond the image
    shape: `(H, W)` of the images; grid: `(Z, Y, X)` of the N voxels
    """

    index: Tensor
    weight: Tensor
    shape: tuple[int, int]
    grid: tuple[int, int, int]

    @classmethod
    def of(cls, grid: Grid, views: Views) -> Taps:
        """Those of the centres of `grid` in `views`, each on pixels of its own size."""
        views.parallel("a network's guess")
        h, w = views.shape
        x, y, z = (torch.from_numpy(np.ascontiguousarray(axis)) for axis in grid.axes())
        index, weight = [], []
        for rotation, shift, pixel in zip(views.rotations, views.shifts, views.pixel_sizes):
            places = []
            for row, offset, count in ((1, shift[1], h), (0, shift[0], w)):
                a, b, c = (float(value) for value in rotation[row])
                lab = c * z[:, None, None] + b * y[None, :, None] + a * x[None, None, :] - offset
                places.append((lab / pixel + 0.5 * (count - 1)).reshape(-1))
            of_view = _bilinear(places[0], places[1], h, w)
            index.append(of_view[0])
            weight.append(of_view[1])
        return cls(torch.stack(index), torch.stack(weight), (h, w), grid.shape)

    def lift(self, images: Tensor) -> Tensor:
        """The images [V, C, H, W] along the rays through each voxel: [V, C, N]."""
        flat = images.flatten(2)
        views, channels, _ = flat.shape
        taken = 0.0
        for tap in range(4):
            where = self.index[:, None, :, tap].expand(views, channels, -1)
            taken = taken + flat.gather(2, where) * self.weight[:, None, :, tap]
        assert isinstance(taken, Tensor)
        return taken

    def project(self, values: Tensor) -> Tensor:
        """Sums of voxel values [N] over the rays of each view's pixels, [V, H, W]; the adjoint of `lift`.

        In units of value × voxel where pixels are as large as voxels.
        """
        h, w = self.shape
        images = values.new_zeros(len(self.index), h * w)
        for tap in range(4):
            images = images.scatter_add(1, self.index[..., tap], self.weight[..., tap] * values)
        return images.unflatten(1, (h, w))

    def on(self, device: torch.device | str) -> Taps:
        """The same on a device."""
        return Taps(self.index.to(device), self.weight.to(device), self.shape, self.grid)

    def part(self, views: Tensor) -> Taps:
        """Those of some views [K]."""
        return Taps(self.index[views], self.weight[views], self.shape, self.grid)


def _bilinear(row: Tensor, column: Tensor, h: int, w: int) -> tuple[Tensor, Tensor]:
    """Pixels [N, 4] and weights [N, 4] of places [N] in pixels."""
    first_row, first_column = row.floor(), column.floor()
    index, weight = [], []
    for down in (0, 1):
        for right in (0, 1):
            i, j = first_row + down, first_column + right
            share = (1 - (row - i).abs()) * (1 - (column - j).abs())
            inside = (i >= 0) & (i < h) & (j >= 0) & (j < w)
            index.append((i.clamp(0, h - 1) * w + j.clamp(0, w - 1)).long())
            weight.append(torch.where(inside, share, 0.0).float())
    return torch.stack(index, -1), torch.stack(weight, -1)


@dataclass(frozen=True)
class Copy:
    """A scene upside down or not, after quarter `turns` of the object about its y axis.

    Frames are mirrored as the object is: what they show of it stays, and rotations stay rotations. After turns they are
    the same, for views are turned as well.
    """

    upside_down: bool
    turns: int

    def images(self, seen: Tensor) -> Tensor:
        """The images [V, C, 2H, 2W] of the copy."""
        return seen.flip(2) if self.upside_down else seen

    def taps(self, taps: Taps) -> Taps:
        """Where the copy's voxels lie in its images."""
        index, weight = (self._moved(part.unflatten(1, taps.grid), 1) for part in (taps.index, taps.weight))
        if self.upside_down:
            h, w = taps.shape
            index = (h - 1 - index // w) * w + index % w
        grid = (int(index.shape[1]), int(index.shape[2]), int(index.shape[3]))
        return replace(taps, index=index.flatten(1, 3), weight=weight.flatten(1, 3), grid=grid)

    def volume(self, values: Tensor) -> Tensor:
        """Values [Z, Y, X] of the scene as the copy has them."""
        return self._moved(values, 0)

    def back(self, values: Tensor) -> Tensor:
        """Values [Z, Y, X] of the copy as the scene has them."""
        turned = torch.rot90(values, -self.turns, (0, 2))
        return turned.flip(1) if self.upside_down else turned

    def _moved(self, values: Tensor, z: int) -> Tensor:
        """Values whose axes from `z` on are z, y and x."""
        flipped = values.flip(z + 1) if self.upside_down else values
        return torch.rot90(flipped, self.turns, (z, z + 2))


COPIES = tuple(Copy(upside_down, turns) for upside_down, turns in product((False, True), range(4)))
"""All of them, as training shows them; the first is the scene itself."""


MOST_LEVELS = 10
"""Levels of a U-Net, at most: the coarsest of eleven is of one pixel where the finest has a thousand."""


@checked_dataclass
class Size:
    """How large a network is; about a million weights by default."""

    image: tuple[Natural, ...] = (16, 24, 32, 32)
    """Channels of the views' encoder, from its finest level to its coarsest."""
    features: Natural = 12
    """Channels that are lifted along the rays, of each view."""
    volume: tuple[Natural, ...] = (16, 40, 80)
    """Channels of the volumes' U-Nets, from the finest level to the coarsest."""

    def __post_init__(self) -> None:
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
