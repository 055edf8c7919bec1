"""How wrong a search can be: the same search of frames that its own result would give, whose poses are known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import interpolate

from ..geometry import Grid
from ..inference import Decision
from ..methods.surface_fit import oversampling
from ..optics.sampling import fringe_sampling
from ..representations import SurfaceMesh
from ..scan import Scan
from .changes import numbers_of
from .derivatives import in_pixels, predicted
from .fixed_matter import Beside
from .gauge import moved_onto
from .poses import FLUX, SHIFT, PoseOptions, PoseSearch

SEED = 0
"""Of the noise of the frames: the same frames always give the same errors."""


@dataclass(frozen=True)
class Searched:
    """A search that is done.

    pixels: edge of the last images [detector pixels]; surfaces: what explains frames better than voxels, or None;
    decisions: on these
    """

    search: PoseSearch
    pixels: int
    surfaces: SurfaceMesh | None
    decisions: tuple[Decision, ...] = ()


Search = Callable[[Scan, PoseOptions], Searched]
"""The whole search of a scan, from its planned exposures on."""


def rehearsed(done: Searched, again: Search) -> np.ndarray:
    """[V, 7] errors of numbers [pixels, rad, logarithms] of another search, from the same plan on, of frames whose
    matter and poses are those that were found.

    The frames have noise with the spectrum of what was left unexplained of the measured ones, and random phases
    (Theiler et al. 1992, Physica D 58, 77): so light that is not even, grain, and what the matter of the search cannot
    be, count as they are. Poses in which the search gets stuck beside matter that has followed them count, too: it
    starts as far from what is to be found as it did (parametric bootstrap; Efron & Tibshirani 1993, chapter 6).
    """
    scan, search = done.search.scan.binned(done.pixels), done.search
    images = _frames(done, scan)
    left = torch.from_numpy(scan.frames) - images
    frames = images + with_random_phases(left, SEED)
    options = replace(
        search.options, uncertain=replace(search.options.uncertain, shift=search.options.uncertain.shift / done.pixels)
    )
    found = again(replace(scan, frames=frames.numpy()), options).search
    true = search.exposures(scan.exposures)
    there = found.exposures(scan.exposures)
    away = numbers_of(replace(there, views=moved_onto(there.views, true.views)), true).numpy()
    away[:, SHIFT] *= done.pixels
    return away


def _frames(done: Searched, scan: Scan) -> Tensor:
    """Frames [V, H, W] of what was found, on the pixels of `scan`."""
    search = done.search
    scales = torch.ones(search.numbers.shape[1], dtype=torch.float64)
    scales[SHIFT] = done.pixels
    if done.surfaces is not None:
        beside = Beside(done.surfaces, scan.exposures, oversampling(scan))
        return beside.frames(search.numbers / scales)
    grid = Grid.of_views(in_pixels(scan.views))
    volume = interpolate(search.volume[None, None], size=grid.shape, mode="trilinear", align_corners=False)[0, 0]
    lit = search.numbers[:, FLUX].exp().float()[:, None, None]
    found = search.exposures(scan.exposures)
    return lit * predicted(volume, grid, found, search.material, fringe_sampling(scan.exposures)).frames


def with_random_phases(images: Tensor, seed: int) -> Tensor:
    """Images [V, H, W] of the same power at all frequencies, and random otherwise."""
    white = torch.randn(images.shape, generator=torch.Generator().manual_seed(seed))
    phases = torch.fft.rfft2(white)
    size = torch.fft.rfft2(images).abs()
    return torch.fft.irfft2(size * phases / phases.abs().clamp_min(1e-12), s=images.shape[-2:])
