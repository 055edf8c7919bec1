"""The light of all projections of a raw file, by their air: found on binned frames, given on whole ones."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from ..checks import InputError
from ..divided_light import DividedLight
from ..inference import ERRORS
from ..optics.air import Box, find_air, has_air
from ..optics.background import ORDER, Light, LightOptions
from ..optics.patterns import cosines

LONGEST = 128
"""Pixels along the longer side of the binned frames, at most."""
BESIDE = 0.05
"""Width of the left and the right border, as a part of a frame's."""
BRIGHTER = 0.02
"""Where a border is brighter than the frame's mean by this part, it shows air, or less matter than the middle."""


@dataclass(frozen=True)
class Look:
    """All projections at once: frames [V, h, w] of pixels `factor` times larger; shape: (H, W) of a whole one."""

    frames: np.ndarray
    factor: int
    shape: tuple[int, int]

    @classmethod
    def at(cls, frame: Callable[[int], np.ndarray], count: int) -> Look:
        """At `count` relative frames [H, W], `frame(i)` one at a time."""
        first = frame(0)
        factor = min(math.ceil(max(first.shape) / LONGEST), *first.shape)
        binned = np.stack([_binned(first if i == 0 else frame(i), factor) for i in range(count)])
        return cls(binned, factor, (first.shape[0], first.shape[1]))

    def air(self) -> float | None:
        """The median level of air in the frames that show some; None where none does."""
        frames = torch.from_numpy(self.frames)
        air = find_air(frames)
        levels = [float(frame[there].mean()) for frame, there in zip(frames, air) if has_air(there[None]).item()]
        return float(np.median(levels)) if levels else None

    def has_matter_beside_air(self) -> bool:
        """Whether the rest of most frames that show air is darker than it by more than it varies itself; else what
        passes for air may be smooth matter that fills the frames."""
        air = find_air(torch.from_numpy(self.frames)).numpy()
        pairs = [(f[there], f[~there]) for f, there in zip(self.frames, air) if there.any() and not there.all()]
        darker = [light.mean() - rest.mean() > ERRORS * light.std() for light, rest in pairs]
        return 2 * sum(darker) > len(self.frames)

    def has_bright_border(self) -> bool:
        """Whether the left or the right border is brighter than the frame, as where matter in the middle absorbs."""
        width = max(1, round(BESIDE * self.frames.shape[2]))
        sides = np.stack([self.frames[:, :, :width], self.frames[:, :, -width:]]).mean(axis=(2, 3)).max(axis=0)
        return bool(np.median(sides / self.frames.mean(axis=(1, 2))) > 1 + BRIGHTER)


@dataclass(frozen=True)
class AirLight:
    """coefficients [V, (K + 1)²] of smooth light; airless: how many projections had no air, and take the mean light;
    doubt: what is not known of it, of whole frames."""

    coefficients: np.ndarray
    airless: int
    doubt: DividedLight

    @classmethod
    def of(cls, look: Look, air: Sequence[Box] = (), asked: bool = False) -> AirLight | None:
        """Of the projections in `look`; None where none of them has air, or all is even.

        air: boxes of it, or nothing to find it; asked: whether even light counts, too. Errors: `InputError` for boxes
        outside the frames.
        """
        boxes = tuple(_shrunk(box, look.factor, look.shape) for box in air)
        options = LightOptions("smooth" if asked else "auto", boxes)
        frames = torch.from_numpy(look.frames)
        usable = has_air(options.air_of(frames))
        if not bool(usable.any()):
            return None
        found = Light.of(frames, options)
        if found.background is None:
            return None
        usable = has_air(found.air)
        coefficients = found.background.coefficients
        coefficients = torch.where(usable[:, None], coefficients, coefficients[usable].mean(dim=0))
        known, count = found.background, len(coefficients)
        variances = known.variances.expand(count, -1)
        left = torch.where(usable[:, None, None], known.covariances, torch.diag_embed(variances))
        powers = known.powers.numpy() * look.factor**2
        doubt = DividedLight(left.numpy(), variances.numpy(), powers, look.shape)
        return cls(coefficients.numpy(), int((~usable).sum()), doubt)

    def factor(self, number: int, shape: tuple[int, int]) -> np.ndarray:
        """The light [H, W] of projection `number`."""
        rows, columns = (cosines(n, ORDER, "cpu").numpy() for n in shape)
        return np.exp(rows.T @ self.coefficients[number].reshape(ORDER + 1, ORDER + 1) @ columns)


def _binned(frame: np.ndarray, factor: int) -> np.ndarray:
    h, w = (n // factor * factor for n in frame.shape)
    return frame[:h, :w].reshape(h // factor, factor, w // factor, factor).mean(axis=(1, 3))


def _shrunk(box: Box, factor: int, shape: tuple[int, ...]) -> Box:
    """A box in binned pixels, of those that lie in it whole, one at least."""
    top, bottom, left, right = box
    inside = 0 <= top < bottom <= shape[0] and 0 <= left < right <= shape[1]
    if not inside:
        raise InputError(
            f"a box of --air must lie within {shape[0]} rows and {shape[1]} columns, its ends after its beginnings, "
            f"but it is rows {top} to {bottom}, columns {left} to {right}; correct it."
        )
    starts = [math.ceil(n / factor) for n in (top, left)]
    ends = [max(start + 1, end // factor) for start, end in zip(starts, (bottom, right))]
    most = [n // factor for n in shape]
    starts, ends = ([min(n, m - k) for n, m in zip(side, most)] for side, k in ((starts, 1), (ends, 0)))
    return starts[0], ends[0], starts[1], ends[1]
