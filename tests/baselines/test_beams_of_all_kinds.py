"""Beams of several pixel sizes, distances and energies in one scan, reconstructed as they are."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch.nn.functional import pad

from helpers.discs import ball_lines
from helpers.misaligned_balls import BALLS, MATERIAL
from holosplat.baselines.algebraic import filtered_backprojection
from holosplat.baselines.tomography import TotalVariation, total_variation
from holosplat.checks import InputError
from holosplat.geometry import Grid, Views, rotation_tilted
from holosplat.model import Instrument
from holosplat.optics.retrieval import Tikhonov, tikhonov
from holosplat.scan import Exposures, Scan
from holosplat.volume import LineIntegrals

PIXEL, SHAPE, COUNT = 3.2e-6, (35, 39), 10
ODD = np.arange(COUNT) % 2 == 1
EQUAL = (PIXEL, np.full(COUNT, 0.1), np.full(COUNT, 20.0))
MIXED = (PIXEL * np.where(ODD, 1.3, 1.0), np.where(ODD, 0.15, 0.1), np.where(ODD, 17.0, 20.0))


def scan_of(beams) -> Scan:
    """Frames of balls, from chords, in beams of these pixels, distances and energies."""
    pixels, distance, energy = beams
    turned = rotation_tilted(np.arange(COUNT) * 180.0 / COUNT, np.where(ODD, 4.0, -4.0))
    views = Views.from_rotations(turned, SHAPE, pixels)
    exposures = Exposures(views, energy, distance, np.full(COUNT, 0.3), np.zeros(COUNT), 20.0)
    instrument = Instrument(exposures, 2)
    fine = exposures.views.refined(2)
    lines = torch.stack([ball_lines(fine, tuple(2 * v for v in ball), 2) for ball in BALLS]).sum(0)
    my, mx = (2 * m for m in instrument.margin)
    frames = instrument.frames(LineIntegrals(pad(lines, (mx, mx, my, my))[:, None], (MATERIAL,)))
    return Scan(frames.numpy(), exposures, np.arange(COUNT) % 5 == 4)


def error(delta: np.ndarray, grid: Grid) -> float:
    """Relative error of δ, the truth from 3³ points a voxel."""
    fine = grid.divided((3, 3, 3))
    x, y, z = (axis / PIXEL for axis in fine.axes())
    inside = np.zeros(fine.shape)
    for a, b, c, r in BALLS:
        inside += (z[:, None, None] - c) ** 2 + (y[:, None] - b) ** 2 + (x - a) ** 2 < r**2
    nz, ny, nx = grid.shape
    truth = MATERIAL.delta * inside.reshape(nz, 3, ny, 3, nx, 3).mean((1, 3, 5))
    return float(np.linalg.norm(delta - truth) / np.linalg.norm(truth))


def test_beams_of_all_kinds_are_as_good_as_equal_ones():
    """Without a common axis, so that the same projector serves both."""
    grid = Grid.centred((SHAPE[1], SHAPE[0], SHAPE[1]), PIXEL)
    errors = {}
    for name, beams in (("equal", EQUAL), ("mixed", MIXED)):
        scan = scan_of(beams)
        frames = torch.from_numpy(scan.frames)
        thickness = tikhonov(frames, scan.exposures, *MATERIAL, options=Tikhonov(iterations=15))
        how = TotalVariation(first=20, iterations=20)
        volume = total_variation(thickness, scan.views, grid, 1.0, lambda fraction: None, options=how)
        errors[name] = error(MATERIAL.delta * volume.numpy(), grid)
    assert errors["equal"] < 0.2
    assert errors["mixed"] < 1.2 * errors["equal"]  # half of its pixels are 1.3 times larger


def test_methods_of_one_raster_refuse_several():
    views = scan_of(MIXED).views
    with pytest.raises(InputError, match=r"one pixel size, but theirs go from 3\.2 to 4\.16 µm; choose those of one"):
        _ = views.pixel_size
    lines, grid = torch.zeros(COUNT, *SHAPE), Grid.of_views(views)
    with pytest.raises(InputError, match=r"back-projection needs views .* on pixels of one size; take sirt, art or tv"):
        filtered_backprojection(lines, views, grid, None, lambda fraction: None)
