"""Information of frames on poses, given that unknown matter adapts to the poses."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ..geometry import Grid
from ..matter import DeltaBeta
from ..optics.retrieval.spectra import Raster, radian, response
from ..projectors.voxels import LatticeProjector
from ..scan import Exposures
from .derivatives import in_pixels, projections

DEPTH = 4
"""Powers of the matter's covariance in which its part of the frames is looked for: with eight, standard errors of few
noisy views are smaller by 3 % or less; with three they are larger by a quarter."""
SINGULAR = 1e-6
"""Directions of that search whose size is less than this part of the largest are those of others."""


@dataclass(frozen=True)
class Leeway:
    """How far matter may be from what it was found to be: a Gaussian field with these standard deviations.

    edges: of edges, along their normals [voxels]; insides: of occupancies within and near the matter; width: standard
    deviation of the Gaussian that white noise is smoothed with to give such a field [voxels]
    """

    edges: float
    insides: float
    width: float


SHARP = Leeway(0.5, 0.0, 2.0)
"""Surfaces of one density: edges that are half a voxel off, over patches of some voxels."""
SOFT = Leeway(1.0, 0.3, 1.0)
"""Voxels, of which few views hardly tell the depth: a third of what is there may be elsewhere."""


class Following:
    """How frames of weak objects change with line integrals, and with occupancies that are near `volume` [Z, Y, X].

    grid: of the volume, lengths in pixels of the views' pitch. Frames are blurred by `blur` [pixels]. The object is
    taken to be weak: its frames are line integrals, filtered (Cloetens et al. 1999, eq. 3).
    """

    def __init__(
        self, volume: Tensor, grid: Grid, exposures: Exposures, material: DeltaBeta, leeway: Leeway, blur: float
    ) -> None:
        views, (delta, beta) = exposures.views, material
        self._projector = LatticeProjector(grid, in_pixels(views))
        of_waves = response(exposures.optical, beta / delta, Raster(views.shape, views.pitch))
        down, across = torch.fft.fftfreq(views.shape[0])[:, None], torch.fft.rfftfreq(views.shape[1])
        blurring = torch.exp(-2 * math.pi**2 * blur**2 * (down**2 + across**2))
        self._waves = (-of_waves * blurring * views.pitch / radian(exposures, delta)).float()
        self._field = _white(_gaussian(grid.shape, leeway.width), grid.shape)
        near = _filtered(volume, _gaussian(grid.shape, 1.0)).clamp(0, 1)
        self._deviations = leeway.edges * _slope(near) + leeway.insides * near

    def frames(self, lines: Tensor) -> Tensor:
        """Changes of frames [..., V, H, W] by those of line integrals [pixels]; symmetric."""
        return torch.fft.irfft2(torch.fft.rfft2(lines) * self._waves, s=lines.shape[-2:])

    def spread(self, frames: Tensor) -> Tensor:
        """The covariance, by the matter's leeway, of frames, times images [V, H, W]."""
        field = self._deviations * self._projector.backproject(self.frames(frames).contiguous())
        field = self._deviations * _filtered(field, self._field.square())
        return self.frames(self._projector.project(field.contiguous()))


def of_poses(
    volume: Tensor,
    grid: Grid,
    exposures: Exposures,
    material: DeltaBeta,
    *,
    left: Tensor,
    leeway: Leeway,
    blur: float,
    places: list[int],
) -> Tensor:
    """[V · K, V · K] float64: information of K numbers of V views, beside matter that may follow them.

    places: of these numbers, among shifts [pixels], turns and the logarithm of the magnification, of which
    `projections` has the derivatives; left: [V] mean squares of what is unexplained of blurred frames, which are
    noise, as in `Normal.of`.

    With C the changes of the frames by the numbers and K those that the matter's leeway makes likely, in units of the
    noise, it is `Cᵀ (1 + K)⁻¹ C` (the Schur complement of the matter in the joint Hessian). The inverse is looked for
    among `C, K C, K² C …`, all columns together, and so never told too much.
    """
    follows = Following(volume, grid, exposures, material, leeway, blur)
    root = (1 / (4 * math.pi * blur**2) / left.clamp_min(1e-18)).sqrt().float()[:, None, None]
    slopes = follows.frames(projections(volume, grid, in_pixels(exposures.views))[1][:, places].transpose(0, 1))
    views = len(exposures)
    columns = torch.zeros(views, len(places), *slopes.shape[1:])
    for v in range(views):
        columns[v, :, v] = root[v] * slopes[:, v]
    powers = [columns.flatten(0, 1)]
    for _ in range(DEPTH):
        powers.append(torch.stack([root * follows.spread(root * image) for image in _unit(powers[-1])]))
    return _quadratic(powers)


def _unit(images: Tensor) -> Tensor:
    """Each image over its length."""
    return images / images.flatten(1).norm(dim=1).clamp_min(1e-30)[:, None, None, None]


def _quadratic(powers: list[Tensor]) -> Tensor:
    """`Cᵀ (1 + K)⁻¹ C` on the span of all but the last of `powers`: C, and K times the one before, made unit."""
    units = torch.cat([_unit(part) for part in powers[:-1]]).flatten(1).double()
    spread = torch.cat(powers[1:]).flatten(1).double()
    inner, moved = units @ units.T, units @ spread.T
    sizes, ways = torch.linalg.eigh(inner)
    kept = sizes > SINGULAR * sizes[-1]
    ways = ways[:, kept] / sizes[kept].sqrt()
    middle = ways.T @ (inner + 0.5 * (moved + moved.T)) @ ways
    across = powers[0].flatten(1).double() @ units.T @ ways
    return across @ torch.linalg.solve(middle, across.T)


def _gaussian(shape: tuple[int, ...], sigma: float) -> Tensor:
    """The transform of a Gaussian on a periodic raster."""
    z, y, x = torch.fft.fftfreq(shape[0]), torch.fft.fftfreq(shape[1]), torch.fft.rfftfreq(shape[2])
    squares = z[:, None, None] ** 2 + y[:, None] ** 2 + x**2
    return torch.exp(-2 * math.pi**2 * sigma**2 * squares)


def _white(transform: Tensor, shape: tuple[int, ...]) -> Tensor:
    """So scaled that white noise of variance 1 keeps its variance."""
    point = torch.zeros(shape)
    point[0, 0, 0] = 1
    return transform / _filtered(point, transform).norm()


def _filtered(field: Tensor, transform: Tensor) -> Tensor:
    return torch.fft.irfftn(torch.fft.rfftn(field) * transform, s=field.shape)


def _slope(field: Tensor) -> Tensor:
    """Its length, by central differences."""
    return torch.stack(torch.gradient(field)).square().sum(0).sqrt()
