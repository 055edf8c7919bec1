"""Two Gaussian blobs of matter, their exact line integrals and scan, by which smooth volumes are judged."""

from __future__ import annotations

import numpy as np
import torch

from holosplat.geometry import Grid, Views
from holosplat.matter import DeltaBeta
from holosplat.model import Instrument
from holosplat.scan import Exposures, Scan
from holosplat.volume import LineIntegrals

PIXEL, SHAPE = 1e-6, (25, 31)
MATERIAL = DeltaBeta(1e-6, 1e-9)
BLOBS = (((-4.0, 2.0, 3.0), 2.6), ((4.0, -3.0, -2.0), 3.2))
"""Centres `(x, y, z)` and standard deviations [pixels]; the occupancy is one in the middle."""


def blob_lines(views: Views, boxes: tuple[int, int] = (0, 0)) -> torch.Tensor:
    """Thickness [V, H, W] [m] on the pixel centres of `views`, as blurred as by `boxes` of a pixel down and across."""
    h, w = views.shape
    total = np.zeros((len(views), h, w))
    x, y = ((np.arange(n) + 0.5 - 0.5 * n) * views.pixel_size / PIXEL for n in (w, h))
    for centre, sigma in BLOBS:
        at = views.rotations @ np.array(centre)
        down, across = (sigma**2 + count / 12 for count in boxes)
        image = np.exp(-((y[:, None] - at[:, 1, None, None]) ** 2) / (2 * down))
        image = image * np.exp(-((x - at[:, 0, None, None]) ** 2) / (2 * across))
        total += np.sqrt(2 * np.pi) * sigma**3 / np.sqrt(down * across) * image
    return torch.from_numpy(total * PIXEL)


def blob_scan(distance: float = 0.12, photons: float | None = None, count: int = 6) -> Scan:
    """Views of 25 × 31 pixels, from waves four times finer."""
    exposures = Exposures.of(Views.evenly_spaced(count, SHAPE, PIXEL), 15.0, distance)
    instrument = Instrument(exposures, 4, torch.float64)
    frames = instrument.frames(LineIntegrals(blob_lines(instrument.views)[:, None], (MATERIAL,))).numpy()
    if photons:
        frames = np.random.default_rng(1).poisson(frames * photons) / photons
    return Scan(frames.astype(np.float32), exposures, np.zeros(count, dtype=bool))


def blobs(grid: Grid) -> torch.Tensor:
    """The occupancy [Z, Y, X] at voxel centres."""
    x, y, z = (axis / PIXEL for axis in grid.axes())
    total = np.zeros(grid.shape)
    for (a, b, c), sigma in BLOBS:
        square = (z[:, None, None] - c) ** 2 + (y[:, None] - b) ** 2 + (x - a) ** 2
        total += np.exp(-square / (2 * sigma**2))
    return torch.from_numpy(total).float()
