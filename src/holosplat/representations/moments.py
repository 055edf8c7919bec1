"""Gaussians with the moments of matter: one a cell of a raster, of the mass, centre and spread of the matter in it.

A cell that is cut by an edge gets a Gaussian that is off its middle and flat along the edge, so that edges stand to a
small part of a cell, where Gaussians in the cells' middles move them by up to half a one. The Fourier transform of the
sum, less its smoothing, comes nearer to that of the matter with the square of the cells, for halves of cells are taken
to be filled evenly.
"""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from ..matter import Matter
from .gaussians import GaussianCloud, raw_of
from .initialise import SMALLEST

HALVES = torch.tensor([[x, y, z] for z in (-0.25, 0.25) for y in (-0.25, 0.25) for x in (-0.25, 0.25)]).double()
"""Centres `(x, y, z)` of the eight halves of a cell, in the order of an array [2, 2, 2] of (z, y, x)."""
HALF = 1 / 48
"""Variance along an axis of a half cell that is full."""
SMOOTH = 1 / 8
"""Variance added along each axis. Gaussians as narrow as their matter leave gaps between the cells of up to three
quarters of a full density; with 1/12 volumes on the same cells, which are Gaussians' means nearly, read 3 % too high,
with 1/6 edges are blurred half as much again (looked at on one scene of 256² pixels; no script keeps it)."""


def moments(halves: Tensor, filled: float) -> tuple[Tensor, Tensor, Tensor]:
    """Mass [N], centre `(x, y, z)` [N, 3] and covariance [N, 3, 3] of the matter in each cell, float64, in cells.

    halves: occupancy [2Z, 2Y, 2X] of half cells, each taken to be filled evenly; filled: share of matter from which on
    a cell counts. The centre of the first cell is (0, 0, 0).
    """
    nz, ny, nx = (n // 2 for n in halves.shape)
    cells = halves.clamp_min(0).reshape(nz, 2, ny, 2, nx, 2).permute(0, 2, 4, 1, 3, 5)
    mass = cells.mean(dim=(3, 4, 5))
    here = mass > filled
    weights = cells[here].reshape(-1, 8).double()
    mass = weights.mean(dim=1)
    weights = weights / (8 * mass[:, None])
    halves = HALVES.to(weights)
    offset = weights @ halves
    second = torch.einsum("nk,ki,kj->nij", weights, halves, halves)
    covariance = second - offset[:, :, None] * offset[:, None] + HALF * torch.eye(3).to(weights)
    return mass, here.nonzero().flip(1) + offset, covariance


def cloud_of_moments(
    mass: Tensor, centre: Tensor, covariance: Tensor, cell: float, unit_length: float, matter: Matter
) -> GaussianCloud:
    """A Gaussian for each `mass` [N], `centre` [N, 3] from the origin and `covariance` [N, 3, 3], float64, in cells.

    Covariances grow by `SMOOTH`. cell: edge of a cell [m]; unit_length [m]: the cloud's unit. matter: of one channel.
    """
    spread, axes = torch.linalg.eigh(covariance)
    axes = axes * torch.linalg.det(axes).sign()[:, None, None]  # a rotation, not a mirror
    x, y, z, w = Rotation.from_matrix(axes.numpy()).as_quat().T
    sigma = (spread.clamp_min(0) + SMOOTH).sqrt()
    peak = mass / ((2 * np.pi) ** 1.5 * sigma.prod(dim=1))
    scale = cell / unit_length
    found = (
        scale * centre,
        torch.log(scale * sigma),
        torch.from_numpy(np.stack([w, x, y, z], axis=1)),
        raw_of(peak.clamp_min(SMALLEST))[:, None],
    )
    return GaussianCloud([values.float() for values in found], unit_length, matter)
