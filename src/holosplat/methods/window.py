"""Matter in a small part of a large field: a run looks at windows about its shadows, and at no more of the frames.

What is left out of the frames acts on none of the waves inside a window, as no matter is there; so what is predicted in
it is exact. What is lost is what fringes beyond it say, and they are below noise and tolerance there. Runs are judged
by whole frames.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.special import chdtri, ndtri
from torch import Tensor
from torch.nn.functional import avg_pool2d

from ..optics.noise import NoiseModel
from ..scan import Scan

LARGE = 256 * 256
"""Pixels of a frame from which on windows are looked for: smaller ones are done soon."""
WORTH = 0.5
"""Part of the frames' pixels that windows may have, at most: with more, little is saved."""
BLOCKS = (8, 32)
"""Edges of the blocks [pixels] in which light is looked at: by its mean, and in the smallest ones by its variance."""
CHANCE = 1e-9
"""Probability that noise alone makes a block show more than noise: frames have some thousands of blocks."""
TOLERANCE = 2e-3
"""Part of a frame's largest contrast below which light counts as even, where there is no noise to say so."""
MARGIN = 16
"""Pixels about all blocks that show more."""
MULTIPLE = 16
"""Rows and columns of windows are multiples of so many, so that frames can be binned and transformed fast."""


@dataclass(frozen=True)
class Windows:
    """A part of each frame. tops, lefts: [V] first rows and columns; shape: rows and columns of all."""

    tops: np.ndarray
    lefts: np.ndarray
    shape: tuple[int, int]

    def of(self, scan: Scan) -> Scan:
        """The scan on these parts of its frames; pixels stay where they are."""
        (h, w), views = self.shape, scan.views
        middles = np.stack([self.lefts + 0.5 * (w - views.shape[1]), self.tops + 0.5 * (h - views.shape[0])], axis=1)
        moved = replace(views, shape=self.shape, shifts=views.shifts + middles * views.pixel_sizes[:, None])
        missing = None if scan.missing is None else self.cut(scan.missing)
        exposures = replace(scan.exposures, views=moved)
        return replace(scan, frames=self.cut(scan.frames), exposures=exposures, missing=missing)

    def cut(self, images: np.ndarray) -> np.ndarray:
        """These parts of images [V, H, W]."""
        (h, w), firsts = self.shape, zip(self.tops, self.lefts)
        return np.stack([image[top : top + h, left : left + w] for image, (top, left) in zip(images, firsts)])


def windows_of(scan: Scan, noise: NoiseModel) -> Windows | None:
    """Windows about all that frames show beyond noise and tolerance; None where they would not be worth it.

    Nothing is left out of small frames, of those in noise with grain or divided by light that is not known, for what
    is beside the matter tells of these. Where all views turn about one axis, windows have the same rows, as tomography
    by slices wants.
    """
    if noise.has_grain or scan.light is not None or scan.is_series or math.prod(scan.views.shape) < LARGE:
        return None
    seen = [shown(torch.from_numpy(frame).double() - 1, float(s)) for frame, s in zip(scan.frames, noise.level)]
    if not all(bool(one.any()) for one in seen):
        return None
    (height, width), ends = scan.views.shape, np.array([_ends(one) for one in seen])
    low, high = np.maximum(ends[:, 0] - MARGIN, 0), np.minimum(ends[:, 1] + MARGIN, [height, width])
    if scan.views.shares_axis:
        low[:, 0], high[:, 0] = low[:, 0].min(), high[:, 0].max()
    h, w = (min(n, MULTIPLE * math.ceil(size / MULTIPLE)) for n, size in zip((height, width), (high - low).max(0)))
    if h * w > WORTH * height * width:
        return None
    first = np.clip((low + high - [h, w]) // 2, 0, [height - h, width - w])
    return Windows(first[:, 0], first[:, 1], (int(h), int(w)))


def shown(contrast: Tensor, sigma: float) -> Tensor:
    """Where a frame [H, W] of `contrast`, with white noise of the standard deviation `sigma`, shows more than noise and
    tolerance, [H, W] bool: in whole blocks."""
    least, found = TOLERANCE * float(contrast.abs().max()), torch.zeros(contrast.shape, dtype=torch.bool)
    for edge in BLOCKS:
        most = -float(ndtri(CHANCE / 2)) * sigma / _counts(contrast, edge).sqrt()
        found |= _spread(_means(contrast, edge).abs() > most.clamp_min(least), edge, found)
    counts = _counts(contrast, BLOCKS[0])
    most = torch.from_numpy(chdtri(counts.numpy(), CHANCE)) / counts * sigma**2
    found |= _spread(_means(contrast.square(), BLOCKS[0]) > most + least**2, BLOCKS[0], found)
    return found


def _means(image: Tensor, edge: int) -> Tensor:
    """Over blocks, of which the last ones may be smaller."""
    return avg_pool2d(image[None, None], edge, ceil_mode=True)[0, 0]


def _counts(image: Tensor, edge: int) -> Tensor:
    """The pixels of each block."""
    rows, columns = (torch.arange(0, n, edge, dtype=image.dtype).sub(n).neg().clamp_max(edge) for n in image.shape)
    return rows[:, None] * columns


def _spread(blocks: Tensor, edge: int, like: Tensor) -> Tensor:
    """Blocks as pixels of an image."""
    h, w = like.shape
    return blocks.repeat_interleave(edge, 0).repeat_interleave(edge, 1)[:h, :w]


def _ends(seen: Tensor) -> tuple[tuple[int, int], tuple[int, int]]:
    """First row and column, and those after the last, of what is seen."""
    rows, columns = (np.flatnonzero(seen.any(dim=axis).numpy()) for axis in (1, 0))
    return (int(rows[0]), int(columns[0])), (int(rows[-1]) + 1, int(columns[-1]) + 1)
