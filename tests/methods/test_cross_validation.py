"""Frames that judges predict, some views at a time, which changes nothing; and what first volumes share."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from holosplat.baselines import HolographicTV
from holosplat.baselines.holographic_tv import retrieved
from holosplat.checks import NoMatterError
from holosplat.geometry import Grid, Views
from holosplat.matter import DeltaBeta, MaterialPrior, Matter
from holosplat.methods import cross_validation
from holosplat.methods.cross_validation import FirstVolumes, Folds, predicted_frames
from holosplat.model import measure
from holosplat.optics import sampling
from holosplat.representations import VoxelGrid
from holosplat.scan import Exposures, Scan

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


def test_phase_retrieval_is_shared_between_folds_and_materials_of_one_ratio(monkeypatch):
    """A phase is what is found: the thickness goes as 1/δ, and each view's is its own."""
    exposures, body = scene()
    exposures = exposures[[0, 2, 4]]
    scan = Scan(measure(body, exposures, 2).numpy(), exposures, np.zeros(3, dtype=bool))
    first = FirstVolumes(Folds.of(scan, binning=1), MaterialPrior.of_ratio(2000.0), lambda stage, fraction: None)
    asked, how = list[DeltaBeta](), HolographicTV(retrieval=5)

    def counted(scan, material, options, on_progress):
        asked.append(material)
        return retrieved(scan, material, options, on_progress)

    monkeypatch.setattr(cross_validation, "retrieved", counted)
    one, two = DeltaBeta(7e-7, 7e-7 / 2000), DeltaBeta(3e-7, 3e-7 / 2000)
    part = replace(first, folds=Folds.of(first.folds.split(1)[0], binning=1), part_of=(first, 1))
    lines = part.lines(part.folds.scan, two, how)
    alone = retrieved(first.folds.split(1)[0], two, how, lambda stage, fraction: None)
    assert lines is not None
    assert float((lines - alone).norm()) < 0.02 * float(alone.norm())
    assert torch.allclose(first.thickness(1, one, how) * one.delta, lines * two.delta, rtol=1e-5)
    assert part.lines(scan, two, how) is None
    assert asked == [two]


def test_that_there_is_no_matter_is_found_once():
    exposures, _ = scene()
    scan = Scan(np.ones((5, *SHAPE), dtype=np.float32), exposures, np.zeros(5, dtype=bool))
    first, made = FirstVolumes(Folds.of(scan), MaterialPrior.of_ratio(2000.0), lambda stage, fraction: None), []

    def make():
        made.append(None)
        raise NoMatterError

    for _ in range(2):
        with pytest.raises(NoMatterError):
            first.once("material", 0, make)
    assert len(made) == 1
