"""Pixels without a value of their own: known to the scan, and without weight in retrieval, tomography and fits."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import torch
from torch import Tensor

from helpers.odd_files import SHAPE, N, a_scan
from holosplat.baselines import TOMOGRAPHIES
from holosplat.beamline.simulate import simulate
from holosplat.fit.problem import Batch
from holosplat.fit.residuals import Prediction, residuals
from holosplat.fit.terms.frames import FrameTerm, Objective
from holosplat.fit.whitened import WhitenedFrames
from holosplat.geometry import Grid, Views
from holosplat.io.formats import read_as, read_frames
from holosplat.io.nxtomo import read_scan, write_scan
from holosplat.io.reading import Part, Reading
from holosplat.materials import parse_material
from holosplat.matter import Matter
from holosplat.model import Instrument
from holosplat.optics.noise import NoiseModel, left_of
from holosplat.optics.retrieval import RETRIEVALS
from holosplat.preprocess.pixels import filled
from holosplat.scan import Exposures, Scan
from holosplat.specimens import random_cells
from holosplat.specimens.scene import MeshScene
from holosplat.workflows.join import join

WATER, SIDE, VIEWS = parse_material("water").delta_beta(20.0), 24, 6
MASK = np.zeros((SIDE, SIDE), bool)
MASK[:, 10:12], MASK[14:17, 14:17] = True, True


@cache
def measured() -> tuple[MeshScene, Scan]:
    """Cells, and their frames whose pixels of the mask are missing."""
    views = Views.evenly_spaced(VIEWS, (SIDE, SIDE), 1e-6)
    scene = MeshScene.of_one_material(random_cells(2, (18e-6, 16e-6, 18e-6), 2), WATER)
    scan = simulate(scene, Exposures.of(views, 20.0, 0.03), is_test=np.zeros(VIEWS, bool))
    frames, missing = filled("a", scan.frames.copy(), np.zeros(scan.frames.shape, bool), MASK, np.arange(VIEWS))
    return scene, Scan(frames, scan.exposures, scan.is_test, missing=missing)


def thickness() -> Tensor:
    scene, scan = measured()
    return (scene.project(scan.views)[1] / WATER.delta).float()


def error(found: Tensor, true: Tensor) -> float:
    return float((found - true).norm() / true.norm())


@pytest.mark.parametrize("name", [name for name in RETRIEVALS if name not in ("admm", "hybrid-input-output")])
def test_retrieval_gives_missing_pixels_no_weight(name):
    scan = measured()[1]
    frames, known, true = torch.from_numpy(scan.frames), ~torch.from_numpy(MASK), thickness()
    found, counted = (RETRIEVALS[name](frames, scan.exposures, *WATER, missing=gaps) for gaps in (scan.gaps, None))
    assert error(found[:, known], true[:, known]) < 0.5 * error(counted[:, known], true[:, known])


@pytest.mark.parametrize("name", TOMOGRAPHIES)
def test_tomography_gives_missing_rays_no_weight(name):
    scene, scan = measured()
    lines, grid, gaps = thickness(), Grid.of_views(scan.views), scan.gaps
    assert gaps is not None
    spoilt = lines.masked_fill(gaps, 0.5 * float(lines.max()))
    true = torch.from_numpy(np.asarray(scene.voxelise(grid).delta) / WATER.delta).float()
    found, counted = (
        TOMOGRAPHIES[name](spoilt, scan.views, grid, 1.0, lambda fraction: None, missing=each) for each in (gaps, None)
    )
    assert error(found, true) < 0.6 * error(counted, true)


def test_no_comparison_of_frames_sees_missing_pixels():
    scan = measured()[1]
    objective = Objective(l1=1.0, ssim=0.5, l2_amplitude=1.0, spectral=1.0, rounded=1.0)
    term = FrameTerm(scan, Instrument(scan.exposures, 2), objective, Matter.one(*WATER))
    predicted = torch.full(scan.frames.shape, 0.9, requires_grad=True)
    batch = Batch(None, torch.zeros(3), torch.tensor(0.5), 0)
    sum((weight * value).sum() for weight, value in term.compared(predicted, batch).values()).backward()  # type: ignore[union-attr]
    assert predicted.grad is not None
    assert scan.gaps is not None
    assert not predicted.grad[scan.gaps].any()
    assert (predicted.grad[~scan.gaps] != 0).float().mean() > 0.9


def test_whitened_frames_and_residuals_leave_missing_pixels_out():
    scene, scan = measured()
    noise = NoiseModel.of_frames(torch.from_numpy(scan.frames))
    lines = thickness() / scan.views.finest
    sees, counts = (
        WhitenedFrames(each, WATER, noise)(lines).value
        for each in (scan, Scan(scan.frames, scan.exposures, scan.is_test))
    )
    assert sees < 0.3 * counts
    said = Prediction(scene, scan.exposures, 2)
    power, images = noise.power(), torch.from_numpy(scan.frames)
    left, whole = (residuals(said, images, power, missing=gaps).residual.sum() for gaps in (scan.gaps, None))
    assert left < 0.3 * whole


def test_a_scan_knows_its_missing_pixels_through_cuts_and_files(tmp_path):
    frames = np.ones((N, *SHAPE), np.float32)
    frames[2, 4, 5], frames[3, 9, 9] = 3.0, -1.0
    lacks = np.zeros(frames.shape, bool)
    lacks[2, 4, 5] = True
    write_scan(tmp_path / "a.nxs", Scan(frames, a_scan().exposures, np.zeros(N, bool), missing=lacks))
    found = read_scan(tmp_path / "a.nxs")
    np.testing.assert_array_equal(found.missing, lacks)  # type: ignore[arg-type]
    assert found.frames[2, 4, 5] == 1
    np.testing.assert_array_equal(found[[2]].cropped(slice(4, 6), slice(5, 8)).missing, lacks[[2], 4:6, 5:8])  # type: ignore[arg-type]
    assert read_as(tmp_path / "a.nxs", Reading()).frames[3, 9, 9] == -1
    whole = read_frames(tmp_path / "a.nxs", Reading())
    assert whole.missing is not None
    assert whole.missing.sum() == 2
    assert whole.missing[3, 9, 9]
    coarse = read_frames(tmp_path / "a.nxs", Reading(part=Part(bin=2)))
    assert coarse.missing is None  # the mean is that of the others
    np.testing.assert_allclose(coarse.frames, 1)
    join([tmp_path / "a.nxs"] * 2, tmp_path / "joined.nxs", flips=["rows", "none"])
    np.testing.assert_array_equal(read_scan(tmp_path / "joined.nxs").missing, np.concatenate([lacks[:, ::-1], lacks]))  # type: ignore[arg-type]


def test_what_is_predicted_without_a_value_is_not_forgiven():
    """Only what was not measured leaves nothing: a prediction that is not a number explains no frame."""
    frames, lacks = np.ones((N, *SHAPE), np.float32), np.zeros((N, *SHAPE), bool)
    lacks[2, 4, 5] = True
    scan = Scan(frames, a_scan().exposures, np.zeros(N, bool), missing=lacks)
    said = torch.ones(N, *SHAPE)
    said[1, 2, 3] = said[2, 4, 5] = torch.nan
    for left in (scan.left(said), left_of(scan.measured, said)):
        assert left[2, 4, 5] == 0
        assert left[1, 2, 3].isnan()
        assert int(left.isnan().sum()) == 1
