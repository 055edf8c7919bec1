"""Cases of measured frames: how raw frames become a case, and what methods are held against."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from helpers.cli import holosplat
from holosplat.geometry import Grid, Views
from holosplat.projectors.voxels import SliceProjector
from holosplat.units import wavenumber
from holosplat.volume import Volume
from holosplat_bench.suite import prepare
from holosplat_bench.suite.folder import BenchFolder
from holosplat_bench.suite.methods import METHODS
from holosplat_bench.suite.prepare import MEASURED, agreement, missing_data
from holosplat_bench.suite.run import Suite, run_suite

pytestmark = pytest.mark.usefixtures("unjudged_runs", "plain_light")

SHAPE, COUNT, PIXEL, BETA = (3, 41), 96, 42.92e-6, 2e-10


@pytest.fixture
def case(tmp_path: Path, monkeypatch):
    """The capsule's case, of a cylinder beside the axis in counts with a dark and a flat field."""
    views = Views.evenly_spaced(COUNT, SHAPE, 1.0)
    x, _, z = np.meshgrid(*Grid.of_views(views).axes(), indexing="ij")
    solid = torch.from_numpy(((x - 4) ** 2 + (z - 5) ** 2 < 64).astype(np.float32).transpose(2, 1, 0).copy())
    projector = SliceProjector(Grid.of_views(views), views.turned_back())
    lines = projector.lines_out(projector.project(projector.volume_in(solid))).numpy() * PIXEL
    counts = 100 + 5000 * np.exp(-2 * wavenumber(20.0) * BETA * lines)
    angles = np.arange(COUNT) * 180 / COUNT
    path = tmp_path / "raw.npz"
    np.savez(path, counts=counts, flat=np.full(SHAPE, 5100.0), dark=np.full(SHAPE, 100.0), angles_deg=angles)
    monkeypatch.setattr(prepare, "fetched", lambda wanted, folder: (path, []))
    told = replace(MEASURED["capsule"].reading.told, axis_column=20.0)
    reading = replace(MEASURED["capsule"].reading, told=told)
    plain = replace(MEASURED["capsule"].correction, rings=None, normalise="none")
    inner = ((x - 4) ** 2 + (z - 5) ** 2 < 36).transpose(2, 1, 0)
    return replace(MEASURED["capsule"], reading=reading, correction=plain), solid.numpy(), inner


def test_few_views_train_and_all_give_the_truth(case):
    given, solid, inner = case
    scan, truth = given.scan(), given.truth()
    assert np.flatnonzero(~scan.is_test).tolist() == list(range(0, 96, 8))
    assert truth.beta[inner].mean() == pytest.approx(BETA, rel=0.02)
    assert abs(truth.beta[solid == 0].mean()) < 0.02 * BETA
    np.testing.assert_allclose(truth.delta, 500 * truth.beta)


def test_agreement_is_correlation_and_slope_near_the_axis():
    grid = Grid.of_views(Views.evenly_spaced(4, SHAPE, PIXEL))
    values = np.random.default_rng(0).random(grid.shape).astype(np.float32)
    far = values.copy()
    far[0, :, 0] = 50.0
    truth = Volume(values, values, grid)
    assert agreement(Volume(values, 0.9 * far, grid), truth) == pytest.approx(
        {"correlation": 1.0, "slope": 0.9}, abs=1e-5
    )
    other = np.random.default_rng(1).random(grid.shape).astype(np.float32)
    assert abs(agreement(Volume(values, other, grid), truth)["correlation"]) < 0.1


def test_a_row_holds_what_all_views_say(case, tmp_path):
    given, _, _ = case
    methods = {name: METHODS[name] for name in ("paganin-fbp",)}
    folder = BenchFolder(tmp_path / "bench")
    suite = Suite([given.name], [101], methods, {}, lambda name, seed: replace(given, seed=seed))
    run_suite(suite, folder)
    (row,) = folder.read_rows()
    assert row.done, row.reason
    assert row.volume["correlation"] > 0.9
    assert row.volume["slope"] == pytest.approx(1.0, abs=0.05)
    assert "measured" in folder.describe_case(given.name, 101)["specimen"]


def test_data_that_are_absent_are_named(tmp_path, monkeypatch):
    assert list(missing_data(("capsule", "tooth"), tmp_path)) == ["capsule", "tooth"]
    monkeypatch.setenv("HOLOSPLAT_DATA", str(tmp_path))
    told = ("--cases", "capsule-dome", "--methods", "paganin-fbp", "--out", tmp_path / "bench")
    done = holosplat("bench", "run", *told, "--data", tmp_path)
    assert done.code == 2
    assert "capsule-dome is skipped, for its data are not at hand" in done.err
    assert "none of the cases has its data at hand" in done.err
