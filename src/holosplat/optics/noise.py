"""How noisy frames are, by the frames alone; pixels that are NaN have no value, and no weight."""

from __future__ import annotations

import math

import torch
from torch import Tensor

TILE, QUIET = 16, 0.05
"""Edge of the tiles in which the noise is measured [pixels], and the quantile of the tiles' values that is believed."""
NORMAL_MEDIAN = 0.6745
"""The median of |x| for a standard normal x."""
NORMS = (1.0, math.sqrt(2), math.sqrt(6))
"""Of the differences of order 0, 1 and 2: roots of the summed squares of 1; 1, -1; 1, -2, 1."""
QUIET_TILE = 0.86
"""Ratio of the estimate from quiet tiles to the standard deviation, in pure noise (measured on frames of about 96²
pixels)."""

PHOTON_RANGE = (1e-3, 1e15)
"""Photons a pixel that noise can be simulated for."""


def with_gaps(frames: Tensor, missing: Tensor | None) -> Tensor:
    """Frames [V, H, W] that are NaN where they are `missing` [V, H, W] bool (None: nowhere)."""
    return frames if missing is None else frames.masked_fill(missing.to(frames.device), torch.nan)


def left_of(measured: Tensor, predicted: Tensor) -> Tensor:
    """Frames [V, H, W] less those predicted, 0 where they are NaN; what is predicted without a value stays NaN."""
    return (measured - predicted).masked_fill(measured.isnan(), 0.0)


def noise_level(images: Tensor) -> float:
    """Standard deviation of white noise on images [V, H, W].

    The estimate uses the medians of |second differences along both axes| (the mask of Immerkær 1996, eq. 2, of norm 6)
    in the quiet tiles. Fringes that fill a tile count as noise. The estimate is some per cent too low. Images of one or
    two rows, or columns, have differences of lower order across them; tiles of few rows are longer.
    """
    differences, norm = _rough(images)
    rows, columns = differences.shape[1:]
    h = min(TILE, rows)
    w = min(TILE if rows >= TILE // 2 else TILE**2 // h, columns)
    tiles = differences.unfold(1, h, h).unfold(2, w, w).flatten(3).nanmedian(dim=-1).values
    return float(tiles.flatten().nanquantile(QUIET)) / (norm * NORMAL_MEDIAN)


def _rough(images: Tensor) -> tuple[Tensor, float]:
    """|Differences| of images [V, H, W] along both axes, of second order where there are three samples, and their norm:
    what they make of the standard deviation of white noise."""
    norm = 1.0
    for axis in (1, 2):
        order = min(2, images.shape[axis] - 1)
        images, norm = images.diff(n=order, dim=axis), norm * NORMS[order]
    return images.abs(), norm


def wavelet_noise(frames: Tensor) -> Tensor:
    """Standard deviation [V] of the noise, float64: median absolute deviation of the finest diagonal Haar wavelets.

    Donoho & Johnstone (1994), section 4.2. Fringes of the finest pitch pass for noise. Frames of one row, or one
    column, have no diagonal; second differences along them take its place.
    """
    i = frames.detach().double()
    if min(i.shape[1:]) < 2:
        differences, norm = _rough(i)
        return differences.flatten(1).nanmedian(1).values / (norm * NORMAL_MEDIAN)
    diagonal = 0.5 * (i[:, :-1, :-1] + i[:, 1:, 1:] - i[:, :-1, 1:] - i[:, 1:, :-1])
    return diagonal.abs().flatten(1).nanmedian(1).values / NORMAL_MEDIAN


def noise_levels(frames: Tensor) -> Tensor:
    """Standard deviation [V] of the white noise on each of frames [V, H, W], float64.

    The lesser of two estimates, for each takes some signal for noise: `noise_level`, its bias mended, where fringes
    fill all tiles (small frames), and `wavelet_noise` where they fill most of the frame (crowded ones).
    """
    return torch.minimum(_of_quiet_tiles(frames), wavelet_noise(frames).cpu())


def sure_noise(frames: Tensor) -> Tensor:
    """The part of `noise_levels` that is surely noise, [V], float64: zero where fringes fill the frames.

    Both estimates agree on white noise, but not on fringes. If the quiet tiles hold fringes of variance a, and all
    wavelets fringes of at least twice that variance, then `σ² ≥ 2 t² - w²`.
    """
    tiles, wavelets = _of_quiet_tiles(frames), wavelet_noise(frames).cpu()
    surely = (2 * tiles.square() - wavelets.square()).clamp_min(0).sqrt()
    return torch.minimum(surely, torch.minimum(tiles, wavelets))


def _of_quiet_tiles(frames: Tensor) -> Tensor:
    return torch.tensor([noise_level(frame[None]) / QUIET_TILE for frame in frames], dtype=torch.float64)


def noise_share(frames: Tensor) -> float:
    """Noise as a share of the contrast of relative frames [V, H, W]: 0 for frames without, about 1 for noise alone."""
    contrast = float((frames.double() - 1).square().nanmean().sqrt())
    return min(1.0, float(noise_levels(frames).mean()) / contrast) if contrast > 0 else 0.0
