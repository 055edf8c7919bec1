"""A tomographic problem in pixels: line integrals of thickness, and the projector that explains them; frames of a
projected thickness through the waves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import interpolate, pad

from ..backends import device
from ..checks import InputError, require
from ..geometry import Grid, Views
from ..matter import DeltaBeta
from ..model import Instrument
from ..projectors.voxels import Projector, projector_for
from ..scan import Exposures
from ..units import wavenumber
from ..volume import LineIntegrals

EVEN = 0.5
"""Share of the light that all rays must pass for their weights to be taken as equal."""
FEWEST = 1e-3
"""Share of the light below which a ray's weight falls no further."""


@dataclass(frozen=True)
class Rays:
    """What tomography works on; lengths are in detector pixels, the smallest ones where they differ.

    measured: line integrals in the projector's order; views, grid: in pixels, the views on the raster of the grid's
    voxels; refine: voxels along a pixel's edge; known: 0 for the rays of missing pixels and 1 for others, in the
    projector's order; None: all are 1.
    """

    projector: Projector
    measured: Tensor
    views: Views
    grid: Grid
    refine: int
    known: Tensor | None = None

    def gaps(self) -> Tensor | None:
        """Rays [V, H, W] bool of missing pixels."""
        return None if self.known is None else self.projector.lines_out(self.known) < 0.5


def rays_of(lines: Tensor, views: Views, grid: Grid, backend: str = "cpu", missing: Tensor | None = None) -> Rays:
    """Line integrals [V, H, W] in metres and where they were taken, made ready for voxels of `grid`, where `backend`
    (resolved) computes. missing: pixels [V, H, W] bool without a value.

    Where the voxels are finer than pixels, lines are interpolated (bilinearly) to a raster of the voxels' pitch.
    """
    pitch = views.finest
    views, grid = in_pixels(lines, views, grid)
    edge = grid.voxel_size[0]
    cubic = bool(np.allclose(grid.voxel_size, edge))
    require(cubic, f"tomography needs cubic voxels, but their edges are {grid.voxel_size} pixels.")
    refine = max(1, round(1 / edge))
    images = (lines.float() / pitch).to(device(backend))
    if refine > 1:
        views = views.refined(refine)
        images = interpolate(images[None], scale_factor=refine, mode="bilinear", align_corners=False)[0]
    projector, known = projector_for(grid, views, backend), None
    if missing is not None:
        wide = missing.repeat_interleave(refine, 1).repeat_interleave(refine, 2)
        known = projector.lines_in((~wide).float().to(images.device))
    return Rays(projector, projector.lines_in(images), views, grid, refine, known)


def in_pixels(lines: Tensor, views: Views, grid: Grid) -> tuple[Views, Grid]:
    """Views and grid with the (smallest) pixel as the unit of length; `InputError` unless the lines are theirs."""
    wanted, shape = (len(views), *views.shape), tuple(lines.shape)
    require(shape == wanted, f"line integrals must have the shape {wanted} of the views, but it is {shape}.")
    bad = lines.numel() - int(torch.isfinite(lines).sum())
    require(bad == 0, f"line integrals must be finite, but {bad} are not; mask or repair them first.")
    pitch = views.finest
    (dx, dy, dz), (x, y, z) = ([length / pitch for length in lengths] for lengths in (grid.voxel_size, grid.origin))
    return views.in_units_of(pitch), Grid(grid.shape, (dx, dy, dz), (x, y, z))


def photons_left(lines: Tensor, exposures: Exposures, material: DeltaBeta) -> Tensor | None:
    """Share of the light [V, H, W] that passes `lines` [V, H, W] [m] of `material`, or None if all pass half of it.

    The logarithm of an intensity I has the variance 1/N I for N photons beside the matter, so I is the weight of a ray
    (Sauer & Bouman 1993, eq. 13). Where all rays weigh about the same, weights change nothing.
    """
    mu = 2 * wavenumber(exposures.energy_kev) * exposures.refraction(*material)[1]
    share = torch.exp(-torch.from_numpy(mu)[:, None, None] * lines).clamp(FEWEST, 1.0).float()
    return share if float(share.min()) < EVEN else None


def bounded(volume: Tensor, lowest: float | None, upper: float | None) -> Tensor:
    """`volume`, changed in place to lie between the bounds there are."""
    return volume if lowest is None and upper is None else volume.clamp_(lowest, upper)


def checked_upper(upper: float | None) -> float | None:
    """The upper bound of the occupancy, None if there is none."""
    if upper is not None and not (np.isfinite(upper) and upper > 0):
        raise InputError(f"the upper bound of the occupancy must be a positive number, or None, but it is {upper:g}.")
    return upper


def frames_of(instrument: Instrument, lines: Tensor, material: DeltaBeta) -> Tensor:
    """Frames from thickness [V, H, W] in metres on the unpadded raster, or on a larger one about the same middle.

    Matter outside it counts as none.
    """
    rows, columns = ((n - seen) // 2 for n, seen in zip(instrument.views.shape, lines.shape[1:]))
    padded = pad(lines, (columns, columns, rows, rows))  # below 0 it cuts
    return instrument.frames(LineIntegrals(padded[:, None], ((material.delta, material.beta),)))


def refined(images: Tensor, factor: int) -> Tensor:
    """Images [V, H, W] on a raster `factor` times finer."""
    if factor == 1:
        return images
    return interpolate(images[None], scale_factor=factor, mode="bilinear", align_corners=False)[0]
