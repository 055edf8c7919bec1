"""Lifting of images of parallel views to the voxels of a lattice, its adjoint, and symmetric copies of a scene."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import torch
from torch import Tensor

from ..geometry import Grid, Views


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
