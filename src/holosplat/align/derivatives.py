"""How frames change with the pose of their view: exact derivatives of projections, carried through the wave optics."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import interpolate

from ..baselines.wave_frames import frames_of
from ..geometry import Grid, Views
from ..matter import DeltaBeta
from ..model import Instrument
from ..projectors.voxels import LatticeProjector
from ..scan import Exposures

NUMBERS = ("shift x", "shift y", "turn x", "turn y", "roll", "distance", "magnification", "flux")
"""What each view has: shifts [pixels], turns about the lab's axes [rad], and the logarithms of the distance and the
magnification over the planned ones, and of the flux."""
SMALL = (0.05, 0.05, 1e-3, 1e-3, 1e-3, 1e-3)
"""Steps along derivatives of line integrals by which those of frames are taken."""
STRETCH = 0.02
"""Share of the distance by which the derivative by its logarithm is taken."""


@dataclass(frozen=True)
class Predicted:
    """Frames [V, H, W] of a volume, and their derivatives [V, 8, H, W] by the numbers of `NUMBERS`."""

    frames: Tensor
    derivatives: Tensor


def predicted(
    volume: Tensor,
    grid: Grid,
    exposures: Exposures,
    material: DeltaBeta,
    oversample: int,
    magnified: bool = False,
) -> Predicted:
    """The frames of occupancies `volume` [Z, Y, X] on `grid` (lengths in pixels of the views' pitch) in `exposures`.

    Derivatives by the pose are those of `projections`, carried through the wave optics by small differences. A view
    that is magnified has smaller pixels p: its line integrals change as `projections` says, and its waves as those of
    a distance that grows with 1/p². magnified: whether this is asked for; else that derivative is zero.
    """
    pixel = exposures.views.pitch
    lines, slopes = projections(volume, grid, in_pixels(exposures.views))
    instrument = Instrument(exposures, oversample)

    def frames(images: Tensor, through: Instrument = instrument) -> Tensor:
        if oversample > 1:
            images = interpolate(images[None], scale_factor=oversample, mode="bilinear", align_corners=False)[0]
        return frames_of(through, images * pixel, material).detach()

    here = frames(lines)
    wanted = SMALL if magnified else SMALL[:-1]
    columns = [(frames(lines + step * slopes[:, k]) - here) / step for k, step in enumerate(wanted)]
    farther = Instrument(replace(exposures, distance=exposures.distance * (1 + STRETCH)), oversample)
    by_distance = (frames(lines, farther) - here) / np.log1p(STRETCH)
    scaled = columns.pop() + 2 * by_distance if magnified else torch.zeros_like(here)
    columns += [by_distance, scaled, here]
    return Predicted(here, torch.stack(columns, dim=1))


def projections(volume: Tensor, grid: Grid, views: Views) -> tuple[Tensor, Tensor]:
    """Line integrals [V, H, W] [pixels] of `volume` [Z, Y, X], and their derivatives [V, 6, H, W] by the pose.

    By shifts of the detector [1/pixel of the view], turns about the lab's axes [1/rad], which are those of
    `model.Alignment`, and the logarithm of the magnification, which moves the centres of pixels towards the middle.
    A turn about x moves matter at depth z by `-ω z` along y, and matter at y along the beam, which no line integral
    sees: so the derivative is that of the first moment `m = ∫ z f dz` along y; likewise about y. A turn about the beam
    turns the image. Derivatives along the image are central differences.
    """
    projector = LatticeProjector(grid, views)
    x, y, z = (torch.from_numpy(axis).float() for axis in grid.axes())
    lines = projector.project(volume)
    parts = [projector.project(volume * weight) for weight in (x, y[:, None], z[:, None, None])]
    along = torch.from_numpy(views.rotations[:, 2]).float()
    moments = sum(along[:, k, None, None] * part for k, part in enumerate(parts))
    assert isinstance(moments, Tensor)
    edges = torch.from_numpy(views.pixel_sizes).float()[:, None, None]
    (across, down), (moment_across, moment_down) = slopes(lines), slopes(moments)
    (h, w), shifts = views.shape, torch.from_numpy(views.shifts).float()[:, :, None, None] / edges[:, None]
    from_x, from_y = (torch.arange(w) + 0.5 - w / 2)[None, None], (torch.arange(h) + 0.5 - h / 2)[None, :, None]
    rolled = (from_y + shifts[:, 1]) * across - (from_x + shifts[:, 0]) * down
    magnified = -from_x * across - from_y * down
    turned = (moment_down / edges, -moment_across / edges)
    return lines, torch.stack([across, down, *turned, rolled, magnified], dim=1)


def slopes(images: Tensor) -> tuple[Tensor, Tensor]:
    """Central differences of images [V, H, W] along columns and along rows [1/pixel]; zero at the borders."""
    across, down = torch.zeros_like(images), torch.zeros_like(images)
    across[:, :, 1:-1] = 0.5 * (images[:, :, 2:] - images[:, :, :-2])
    down[:, 1:-1] = 0.5 * (images[:, 2:] - images[:, :-2])
    return across, down


def in_pixels(views: Views) -> Views:
    """The same views with the pitch as the unit of length."""
    return views.in_units_of(views.pitch)
