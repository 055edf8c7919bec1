"""A bump in closed form, and the beam that images it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from holosplat.geometry import Grid, Views
from holosplat.scan import Exposures
from holosplat.units import wavelength, wavenumber
from holosplat.volume import Volume

ENERGY = 20.0  # keV
LAMBDA, K = wavelength(ENERGY), wavenumber(ENERGY)
PITCH = 0.4e-6  # m
SHAPE = (37, 54)
DOUBLE, COMPLEX = torch.float64, torch.complex128


def at(lambda_z: float, pitch: float = PITCH) -> float:
    """The distance [m] at which λz is `lambda_z` squared pitches."""
    return lambda_z * pitch**2 / LAMBDA


def pixels(views: Views, v: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates of pixel centres [m] of view v: x [1, W] and y [H, 1] (docs/conventions.md)."""
    (h, w), p, (sx, sy) = views.shape, views.pixel_size, views.shifts[v]
    return ((np.arange(w) + 0.5 - w / 2) * p + sx)[None], ((np.arange(h) + 0.5 - h / 2) * p + sy)[:, None]


@dataclass(frozen=True)
class Bump:
    """An object of Gaussian thickness across the beam, at `centre + velocity · time`, from every side [m]."""

    beta: float
    delta: float
    thickness: float = 2e-6
    centre: tuple[float, float] = (0.0, 0.0)
    sigma: tuple[float, float] = (2 * PITCH, 3 * PITCH)
    velocity: tuple[float, float] = (0.0, 0.0)

    def at(self, time: float) -> Bump:
        moved = (self.centre[0] + self.velocity[0] * time, self.centre[1] + self.velocity[1] * time)
        return replace(self, centre=moved, velocity=(0.0, 0.0))

    def depth(self, views: Views) -> Tensor:
        """The thickness [V, H, W] in metres."""
        assert self.velocity == (0.0, 0.0), "a moving object is asked where it is first"
        images = []
        for v in range(len(views)):
            x, y = pixels(views, v)
            u = ((x - self.centre[0]) / self.sigma[0]) ** 2 + ((y - self.centre[1]) / self.sigma[1]) ** 2
            images.append(self.thickness * np.exp(-0.5 * u))
        return torch.from_numpy(np.stack(images))

    def project(self, views: Views) -> tuple[Tensor, Tensor]:
        return self.beta * self.depth(views), self.delta * self.depth(views)

    def voxelise(self, grid: Grid) -> Volume:
        raise NotImplementedError


def exposures(shape: tuple[int, int] = SHAPE, distance=0.02, psf: float = 0.0, count: int = 1) -> Exposures:
    """Exposures from one side, with one or more distances [m]."""
    views = Views.from_angles([0.0] * count, shape, PITCH)
    return replace(Exposures.of(views, ENERGY, 1.0, psf), distance=np.broadcast_to(distance, count))
