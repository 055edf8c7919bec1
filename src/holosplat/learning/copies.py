"""Copies of a scene, mirrored and turned: they have the same views, so a network should guess the same of them.

Where its guesses differ, it guesses by what frames do not say. The copies are exact: voxels, pixels and the taps that
join them change places, and no number is reckoned anew.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product

import torch
from torch import Tensor

from .lattice import Taps


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
