"""The total δ of runs of every kind, in numbers and in words."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from helpers.contact import contact_scan
from helpers.runs import CELL, KNOWN, PIXEL, SHAPE, SMALL, scene
from holosplat.baselines import HolographicTV
from holosplat.beamline.simulate import simulate
from holosplat.checks import InputError
from holosplat.fit.problem import Schedule
from holosplat.fit.residuals import Prediction
from holosplat.geometry import Grid, Views
from holosplat.matter import MaterialPrior, Matter
from holosplat.methods import (
    HolographicVoxels,
    PerView,
    SmoothVolume,
    SurfaceFit,
    Surfaces,
    Task,
    VoxelFit,
    Voxels,
)
from holosplat.methods.coarse import CoarseToFine
from holosplat.methods.modulation import Total
from holosplat.methods.uncertain import Determined
from holosplat.report.content import ReportContent
from holosplat.report.page import score_tables
from holosplat.representations import VoxelGrid
from holosplat.scan import Exposures
from holosplat.workflows.reconstruct import load_reconstruction, reconstruct
from holosplat.workflows.run_folder import RunFolder
from holosplat.workflows.totals import MOST_VIEWS, TotalMatter, in_words, total_of_run

VOLUME = HolographicTV(iterations=40, corrections=3, inner=10, refine=1)
COARSE = CoarseToFine(coarse_steps=4, views=1, turns=1)
METHODS = {
    "gaussians": SMALL,
    "surfaces": Surfaces(
        gaussians=replace(SMALL, volume=VOLUME, coarse=COARSE), fit=SurfaceFit(schedule=Schedule(steps=4))
    ),
    "voxels": Voxels(VOLUME, VoxelFit(steps=4)),
    "volume": SmoothVolume(replace(VOLUME, upper=0.0), rounds=1, iterations=4),
    "per-view": PerView("ctf", "tv"),
}


@pytest.mark.parametrize("name", METHODS)
def test_every_method_has_a_total_near_the_truth(scan, name):
    """After short fits, to 20 %; the volume of the known material is the same number over its δ."""
    found = reconstruct(scan, KNOWN, METHODS[name], matter=METHODS[name].kinds_of_matter[0])
    true = CELL.delta * sum(mesh.volume for mesh in scene().meshes)
    assert found.total is not None
    assert found.total.value == pytest.approx(true, rel=0.2, abs=0)
    assert found.total.error is not None
    assert 0.02 * true < found.total.error < 0.3 * true
    assert found.total.words.startswith("total δ")
    assert "of the material" in found.total.words


def test_with_nothing_known_there_is_an_interval(scan):
    found = reconstruct(scan.binned(2), MaterialPrior.unknown(), METHODS["voxels"], matter="levels")
    assert found.total is not None
    assert "cannot tell it without the ratio δ/β; between" in found.total.words


def test_frames_in_contact_tell_the_total_of_absorption():
    """A ball of known β: `4π/3 r³ β`, of frames of a few rows."""
    ball = (2.0, 0.0, -3.0, 5.0, 1e-7)
    scan = contact_scan([ball], (13, 40), photons=5000)
    found = reconstruct(scan, MaterialPrior.unknown(), HolographicVoxels(VOLUME))
    assert found.total is not None
    assert found.total.quantity == "β"
    assert found.total.words.startswith("total β")
    assert found.total.value == pytest.approx(4 / 3 * np.pi * 5.0**3 * 1e-7 * 2e-6**3, rel=0.1, abs=0)


def test_one_row_and_strong_absorbers_have_a_total():
    scan = contact_scan([(2.0, 0.0, -3.0, 5.0, 3e-6)], (1, 40))
    found = reconstruct(scan, MaterialPrior.of_ratio(10), HolographicVoxels(VOLUME))
    assert found.total is not None
    assert found.total.value is not None
    assert found.total.error is not None
    assert np.isfinite([found.total.value, found.total.error]).all()


def test_two_materials_and_free_channels_have_a_total():
    """Their own model says what they predict, for no single ratio is theirs. Eleven views: of eight the total is 5 %
    too large, a little more or less by processor."""
    scan = simulate(scene(), Exposures.of(Views.evenly_spaced(11, SHAPE, PIXEL), 20.0, 0.1))
    grid = Grid.of_views(scan.views)
    true = np.asarray(scene().voxelise(grid).delta, dtype=np.float64)
    occupancy = torch.from_numpy(true / CELL.delta).float()
    half = torch.stack([0.5 * occupancy, occupancy])
    for matter, values in (
        (Matter.several(CELL, (0.5 * CELL.delta, 0.5 * CELL.beta)), half),
        (Matter.free(*CELL), torch.stack([occupancy, occupancy])),
    ):
        said = Prediction(VoxelGrid(values, grid, matter), scan.train().exposures, 2)
        found = total_of_run(said, scan.train(), Task(scan.train(), MaterialPrior.of_ratio(CELL.ratio)))
        assert found.value == pytest.approx(true.sum() * np.prod(grid.voxel_size), rel=0.05, abs=0)


def test_an_empty_volume_is_said_to_be_empty(scan):
    grid = Grid.of_views(scan.views)
    empty = VoxelGrid(torch.zeros(1, *grid.shape), grid, Matter.one(*CELL))
    train = scan.train()
    found = total_of_run(Prediction(empty, train.exposures, 1), train, Task(train, KNOWN))
    assert (found.value, found.error, found.held) == (None, None, 0.0)
    assert found.words == "total δ: none, for the volume is empty"
    assert TotalMatter.from_dict(json.loads(json.dumps(found.as_dict()))) == found


def test_large_scans_are_binned_and_thinned(scan, monkeypatch):
    """The total is the same to its error."""
    monkeypatch.setattr("holosplat.workflows.totals.MOST_VOXELS", 30_000)
    grid, train = Grid.of_views(scan.views), scan.train()
    true = np.asarray(scene().voxelise(grid).delta, dtype=np.float64)
    voxels = VoxelGrid(torch.from_numpy(true / CELL.delta).float()[None], grid, Matter.one(*CELL))
    many = train[np.tile(np.arange(len(train)), 4)]
    assert len(many) > MOST_VIEWS
    found = total_of_run(Prediction(voxels, many.exposures, 2), many, Task(many, KNOWN))
    assert found.value == pytest.approx(true.sum() * np.prod(grid.voxel_size), rel=0.05, abs=0)


@pytest.mark.parametrize(("low", "high", "share"), [(480.0, 520.0, 0.036), (300.0, 800.0, 0.247)])
def test_a_ratio_known_to_a_range_is_a_doubt(scan, low, high, share):
    """A quarter of the interval of 95 % joins the error."""
    grid, train = Grid.of_views(scan.views), scan.train()
    true = np.asarray(scene().voxelise(grid).delta, dtype=np.float64)
    voxels = VoxelGrid(torch.from_numpy(true / CELL.delta).float()[None], grid, Matter.one(*CELL))
    constants = (Determined("delta_beta", CELL.ratio, low, high, (100.0, 5000.0), True),)
    task = Task(train, MaterialPrior.of_ratio(CELL.ratio))
    found = total_of_run(Prediction(voxels, train.exposures, 2), train, task, constants)
    assert found.error is not None
    assert found.value is not None
    assert found.error / found.value == pytest.approx(share, rel=0.15)


def test_words():
    sure, unsure = Total(3.414e-21, 1.2e-22, 3.4e-21), Total(3e-21, 9e-22, 1e-21)
    assert in_words(sure, "δ") == "total δ 3.41e-21 m³ ± 3.5 %"
    assert in_words(sure, "δ", 1e-6) == "total δ 3.41e-21 m³ ± 3.5 % (3.41e-15 m³ of the material)"
    expected = "total δ: the frames cannot tell it; between 1.2e-21 and 4.8e-21 m³"
    assert in_words(unsure, "δ") == f"{expected}; the volume itself holds 1e-21"
    assert "between 0 and" in in_words(Total(-1e-21, 1e-21, 1e-21), "β")
    assert "between 0 and -3e-21" in in_words(Total(-1e-21, 1e-21, -1e-21), "β")
    with pytest.raises(InputError, match="a total must be what reconstruct wrote"):
        TotalMatter.from_dict({"value_m3": 1})


def test_files_keep_it(scan, tmp_path):
    found = reconstruct(scan, KNOWN, METHODS["per-view"], folder=RunFolder(tmp_path / "run"))
    assert load_reconstruction(RunFolder(tmp_path / "run")).total == found.total


def test_the_report_has_its_numbers(scan):
    found = reconstruct(scan, KNOWN, METHODS["per-view"])
    volume = found.object.voxelise(Grid.of_views(scan.views))
    tables = score_tables(ReportContent("a run", volume, 20.0, 1e-6, total=found.total))
    assert [row[0] for row in tables[0].rows] == [
        "total δ by the frames",
        "its standard error",
        "what the volume holds",
        "in words",
    ]
    assert found.total is not None
    empty = replace(found.total, value=None, error=None)
    assert len(score_tables(ReportContent("a run", volume, 20.0, 1e-6, total=empty))[0].rows) == 1
