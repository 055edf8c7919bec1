"""Frames that judges predict: some views at a time, which changes nothing."""

from __future__ import annotations

import numpy as np
import torch

from holosplat.geometry import Grid, Views
from holosplat.matter import Matter
from holosplat.methods.cross_validation import predicted_frames
from holosplat.model import measure
from holosplat.optics import sampling
from holosplat.representations import VoxelGrid
from holosplat.scan import Exposures

SHAPE, PIXEL = (21, 33), 1e-6


def scene() -> tuple[Exposures, VoxelGrid]:
    """Five views in turn at two distances, of a rectangular, odd size, and a smooth body off the middle."""
    views = Views.evenly_spaced(5, SHAPE, PIXEL)
    exposures = Exposures.of(views, 20.0, np.array([0.02, 0.05, 0.02, 0.05, 0.02]), 0.6)
    grid = Grid.of_views(views)
    z, y, x = np.meshgrid(*grid.axes()[::-1], indexing="ij")
    squared = ((z + 2e-6) / 5e-6) ** 2 + (y / 4e-6) ** 2 + ((x - 3e-6) / 6e-6) ** 2
    body = torch.from_numpy(np.exp(-squared)).float()
    return exposures, VoxelGrid(body[None], grid, Matter.one(7e-7, 3e-10))


def test_frames_are_those_of_each_view_by_itself(monkeypatch):
    exposures, body = scene()
    wanted = torch.cat([measure(body, exposures[[i]], 2) for i in range(5)])
    contrast = float((wanted - 1).abs().max())
    assert contrast > 0.01
    assert float((predicted_frames(exposures, body, 2) - wanted).abs().max()) < 1e-4 * contrast
    monkeypatch.setattr(sampling, "MOST_SAMPLES", 1)
    assert torch.equal(predicted_frames(exposures, body, 2), wanted)


def test_views_at_a_time_are_alike_and_few_enough(monkeypatch):
    exposures, _ = scene()
    together = [views.tolist() for views in sampling.alike(exposures, 1)]
    assert together == [[0, 2, 4], [1, 3]]
    rows, columns = (n + 2 * m for n, m in zip(SHAPE, sampling.padding(exposures[[0]], 1)))
    monkeypatch.setattr(sampling, "MOST_SAMPLES", 2 * rows * columns)
    assert [views.tolist() for views in sampling.alike(exposures, 1)][:2] == [[0, 2], [4]]
