"""Two balls, their chords and their scan, by which voxels and neural fields are judged."""

from __future__ import annotations

import numpy as np
import torch

from holosplat.fit.terms.frames import SpectralMisfit
from holosplat.geometry import Grid, Views
from holosplat.matter import Matter
from holosplat.model import Instrument, Model
from holosplat.optics.sampling import fringe_sampling
from holosplat.representations import VoxelGrid
from holosplat.scan import Exposures, Scan
from holosplat.volume import LineIntegrals, Object
from holosplat_bench.opponents.fields import Encoding, Network

PIXEL, DELTA, BETA = 1e-6, 1e-6, 1e-9
ONE = Matter.one(DELTA, BETA)
BALLS = (((-5.0, 2.0, 3.0), 4.0), ((4.0, -3.0, -2.0), 5.0))
"""Centres `(x, y, z)` and radii of the truth [pixels]."""
NETWORK = Network(Encoding(levels=3, features=2, coarsest=8.0, finest=2.0, log2_size=12), hidden=16, layers=1)


def chords(views: Views) -> torch.Tensor:
    """Thickness of the balls [V, H, W] [m] on the pixel centres of `views`."""
    h, w = views.shape
    total = np.zeros((len(views), h, w))
    x, y = ((np.arange(n) + 0.5 - 0.5 * n) * views.pixel_size for n in (w, h))
    for centre, radius in BALLS:
        at = views.rotations @ (np.array(centre) * PIXEL)
        apart = (y[:, None] - at[:, 1, None, None]) ** 2 + (x - at[:, 0, None, None]) ** 2
        total += 2 * np.sqrt(np.clip((radius * PIXEL) ** 2 - apart, 0, None))
    return torch.from_numpy(total)


def scan(photons: float | None = None, count: int = 6) -> Scan:
    """Frames of 25 × 28 pixels of the two balls, from waves four times finer."""
    exposures = Exposures.of(Views.evenly_spaced(count, (25, 28), PIXEL), 15.0, 0.12)
    instrument = Instrument(exposures, 4, torch.float64)
    frames = instrument.frames(LineIntegrals(chords(instrument.views)[:, None], ((DELTA, BETA),))).numpy()
    if photons:
        frames = np.random.default_rng(1).poisson(frames * photons) / photons
    return Scan(frames.astype(np.float32), exposures, np.zeros(count, dtype=bool))


def truth(grid: Grid) -> torch.Tensor:
    """The balls' occupancy [Z, Y, X], sampled at voxel centres."""
    x, y, z = (axis / PIXEL for axis in grid.axes())
    inside = [
        (z[:, None, None] - c) ** 2 + (y[:, None] - b) ** 2 + (x - a) ** 2 < r**2 for (a, b, c), r in BALLS
    ]  # fmt: skip
    return torch.from_numpy(np.any(inside, axis=0).astype(np.float32))


def error(found: np.ndarray, grid: Grid) -> float:
    """Relative error of δ/DELTA."""
    true = truth(grid).numpy()
    return float(np.linalg.norm(found / DELTA - true) / np.linalg.norm(true))


def misfit_of(measured: Scan, found: Object) -> float:
    """Σ misfit of an object, by the same measure for all."""
    instrument = Instrument(measured.exposures, fringe_sampling(measured.exposures))
    with torch.no_grad():
        return float(SpectralMisfit(measured, instrument, ONE, 0.3)(Model(found, instrument).frames()).sum())


def blurred_start(grid: Grid, matter: Matter = ONE) -> VoxelGrid:
    """Half of the truth, smeared out."""
    smeared = torch.nn.functional.avg_pool3d(truth(grid)[None, None], 5, stride=1, padding=2)[0]
    return VoxelGrid(0.5 * smeared.repeat(len(matter), 1, 1, 1), grid, matter)
