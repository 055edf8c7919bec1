"""Every kind of method by the same commands: reconstruct, evaluate, render, export, and the report."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from helpers.cli import COLUMNS, PIXEL, ROWS, holosplat, refused, worked
from helpers.pictures import undrawn
from holosplat.geometry import Grid
from holosplat.io.nxtomo import read_scan
from holosplat.io.volumes import read_volume
from holosplat.workflows.evaluate import render
from holosplat.workflows.reconstruct import load_reconstruction
from holosplat.workflows.run_folder import RunFolder

pytestmark = pytest.mark.usefixtures("unjudged_runs")

START = ["volume.retrieval=20", "volume.iterations=30", "volume.corrections=2", "volume.inner=8", "volume.refine=1"]
CLOUD = [*START, "spacing_px=2", "approximate_steps=5", "fit.schedule.steps=30"]
COARSE = ["coarse.coarse_steps=4", "coarse.views=1", "coarse.turns=1"]
QUICK: dict[str, list[str]] = {
    "gaussians": CLOUD,
    "surfaces": [*(f"gaussians.{change}" for change in (*CLOUD, *COARSE)), "fit.schedule.steps=6"],
    "voxels": [*START, "fit.steps=6", "fit.coarse_steps=4"],
    "neural-field": [*START, "fit.warmup_steps=30", "fit.warmup_rays=512", "fit.probes=256", "fit.schedule.steps=4"],
    "holographic-tv": START,
    "tikhonov-tv": [],
}
"""Methods of every kind, in a few steps."""
KINDS = {"holographic-tv": "voxels", "tikhonov-tv": "voxels"}
"""What a method makes where that is not called as the method is."""
TITLES = {
    "gaussians": "Gaussian reconstruction",
    "surfaces": "Reconstruction as closed surfaces",
    "voxels": "Voxel reconstruction",
    "neural-field": "Reconstruction as a field of ",
}
FILES = {"manifest.json", "config.json", "metrics.csv", "object.h5", "summary.json", "source.json", "report.html"}
FILES.add("provenance.json")


@pytest.fixture(scope="module", params=QUICK)
def method(request) -> str:
    return request.param


@pytest.fixture(scope="module")
def run(shop, method, tmp_path_factory) -> Path:
    """A run of the method on the shop's scan."""
    out = tmp_path_factory.mktemp(method) / "run"
    changes = [word for change in QUICK[method] for word in ("--set", change)]
    options = ["--method", method, *changes, "--material", "haemoglobin", "--seed", 2]
    with undrawn():
        done = worked(holosplat("reconstruct", shop.scan, "--out", out, *options))
    assert "held-out frames: SSIM" in done.out
    assert f"report: {out / 'report.html'}" in done.err
    return out


def test_a_run_folder_says_what_made_it(method, run):
    kind = KINDS.get(method, method)
    stages = {"surfaces": {"metrics_0.csv"}, "voxels": {"metrics_1.csv"}}.get(method, set())
    fitted = set() if method in KINDS else {"checkpoint.pt", "checkpoint_before.pt"}
    assert {path.name for path in run.iterdir()} == FILES | stages | fitted
    config, summary = (json.loads((run / f"{name}.json").read_text()) for name in ("config", "summary"))
    assert config["method"]["kind"] == summary["method"]
    assert (summary["kind"], summary["finished"]) == (kind, True)
    found = load_reconstruction(RunFolder(run))
    assert (found.object.kind, found.object.described) == (kind, summary["size"])
    assert found.object.matter.single
    page = (run / "report.html").read_text()
    assert TITLES[kind] in page
    assert summary["size"] in page


def test_it_is_scored_by_frames_and_volume(shop, run):
    done = worked(holosplat("evaluate", run, "--truth", shop.truth, "--json"))
    scores = json.loads(done.out)
    assert scores["dice"] > 0.6
    assert scores["ssim"] > 0.3
    assert "report:" in done.err


def test_its_frames_and_its_volume_are_those_of_the_object(shop, run, tmp_path):
    worked(holosplat("render", run, "--scan", shop.scan, "--out", tmp_path / "p.nxs"))
    worked(holosplat("export", run, "--volume", tmp_path / "v.h5"))
    result, scan = load_reconstruction(RunFolder(run)), read_scan(shop.scan)
    np.testing.assert_array_equal(read_scan(tmp_path / "p.nxs").frames, render(result, scan.test().exposures))
    volume, grid = read_volume(tmp_path / "v.h5"), Grid.centred((COLUMNS, ROWS, COLUMNS), PIXEL)
    np.testing.assert_array_equal(volume.delta, result.object.voxelise(grid).delta)


def test_a_finished_run_is_resumed_without_work(shop, method, run):
    before = (run / "object.h5").read_bytes(), (run / "metrics.csv").read_bytes()
    changes = [word for change in QUICK[method] for word in ("--set", change)]
    options = ["--method", method, *changes, "--material", "haemoglobin", "--seed", 2, "--resume"]
    worked(holosplat("reconstruct", shop.scan, "--out", run, *options))
    assert (run / "metrics.csv").read_bytes() == before[1]
    assert (run / "object.h5").read_bytes() == before[0]


def test_its_config_makes_it_again(shop, method, run, tmp_path):
    options = ["--config", run / "config.json", "--material", "haemoglobin", "--seed", 2]
    worked(holosplat("reconstruct", shop.scan, "--out", tmp_path / "again", *options))
    state, wanted = (load_reconstruction(RunFolder(path)).object.parameters() for path in (tmp_path / "again", run))
    assert state.keys() == wanted.keys()
    for name, value in wanted.items():
        np.testing.assert_array_equal(state[name].numpy(), value.numpy(), err_msg=name)


def test_surfaces_are_cut_out_of_gaussians_or_there_already(method, run, tmp_path):
    outcome = holosplat("surface", run, "--out", tmp_path / "bodies", "--steps", 1)
    if method in ("gaussians", "surfaces"):
        worked(outcome)
    else:
        refused(outcome, "surfaces are cut out of Gaussians", KINDS.get(method, method), "--method gaussians")
        assert not (tmp_path / "bodies").exists()
