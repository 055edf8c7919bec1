"""Cells, their exposures and differences of frames, for the tests of the imaging chain."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from holosplat.geometry import Views, rotation_y
from holosplat.materials import HAEMOGLOBIN
from holosplat.scan import Exposures
from holosplat.specimens.red_cells import random_cells
from holosplat.specimens.scene import MeshScene

PIXEL, SHAPE = 3.2e-6, (65, 80)


def cells() -> MeshScene:
    h, w = SHAPE
    found = random_cells(5, (0.7 * w * PIXEL, 0.8 * h * PIXEL, 0.7 * w * PIXEL), 4, 16 * PIXEL)
    return MeshScene.of_one_material(found, HAEMOGLOBIN.delta_beta(20.0))


def taken(shape: tuple[int, int] = SHAPE, pixel: float = PIXEL, psf: float = 0.3, count: int = 4) -> Exposures:
    shifts = 1e-6 * np.arange(2 * count).reshape(count, 2)
    views = Views(rotation_y(45.0 * np.arange(count)), shifts, shape, pixel)
    exposures = Exposures.of(views, 20.0, 0.1, psf)
    return replace(exposures, time=1e-6 * np.arange(count))


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
