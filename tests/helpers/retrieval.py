"""Bodies in closed form and their holograms, for the tests of phase retrieval."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from holosplat.geometry import Views
from holosplat.model import Instrument
from holosplat.scan import Exposures
from holosplat.units import wavelength, wavenumber

ENERGY = 20.0  # keV
LAMBDA, K = wavelength(ENERGY), wavenumber(ENERGY)
PITCH = 0.5e-6  # m
DELTA, BETA = 7.4e-7, 2.6e-10  # haemoglobin
CELL_DELTA, CELL_BETA = 2.7e-8, -1.5e-11
"""δ and β of a red cell minus plasma at 20 keV: it absorbs less than what surrounds it."""
DOUBLE = torch.float64
SHAPE = (63, 75)
HOLOGRAPHIC = 24.8 * PITCH**2 / LAMBDA  # m


def at(lambda_z: float) -> float:
    """The distance [m] at which λz is `lambda_z` squared pitches."""
    return lambda_z * PITCH**2 / LAMBDA


def exposures(
    shape: tuple[int, int] = SHAPE, distance: float | np.ndarray = HOLOGRAPHIC, psf: float = 0.0, count: int = 1
) -> Exposures:
    """Exposures, each of a pose of its own, with one or more distances [m]."""
    views = Views.from_angles(10.0 * np.arange(count), shape, PITCH)
    return replace(Exposures.of(views, ENERGY, 1.0, psf), distance=np.broadcast_to(distance, count))


def pixels(views: Views) -> tuple[Tensor, Tensor]:
    """Coordinates of pixel centres [m]: x [1, W] and y [H, 1]."""
    h, w = views.shape
    x, y = ((torch.arange(n, dtype=DOUBLE) + 0.5 - n / 2) * views.pixel_size for n in (w, h))
    return x[None], y[:, None]


def gaussian(views: Views, height: float, sigma_px: float, centre_px: tuple[float, float] = (3.3, -5.2)) -> Tensor:
    """A Gaussian [H, W] of `height`."""
    x, y = pixels(views)
    return height * torch.exp(-0.5 * _squared_distance(x, y, centre_px) / (sigma_px * PITCH) ** 2)


def _squared_distance(x: Tensor, y: Tensor, centre_px: tuple[float, float]) -> Tensor:
    return (x - centre_px[0] * PITCH) ** 2 + (y - centre_px[1] * PITCH) ** 2


def taken(
    thickness: Callable[[Views], Tensor], where: Exposures, delta: float = DELTA, beta: float = BETA
) -> tuple[Tensor, Tensor]:
    """Thickness [V, H, W], its means over pixels, and frames of it: float64, four samples to the pixel."""
    instrument = Instrument(where, 4, DOUBLE)
    lines = thickness(instrument.views).expand(len(where), -1, -1)
    fine = thickness(where.views.refined(4))
    means = torch.nn.functional.avg_pool2d(fine[None], 4)[0].expand(len(where), -1, -1)
    return means, instrument.image(lines * beta, lines * delta)
