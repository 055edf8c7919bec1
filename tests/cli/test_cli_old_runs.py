"""Runs of version 0.1.0: they are evaluated, rendered, exported and refined, their settings run, none is resumed.

The files are what version 0.1.0 wrote (20 steps on two balls in four training frames), but for the checkpoint.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from helpers.cli import everything_in, holosplat, refused, worked
from holosplat.geometry import Grid
from holosplat.io.nxtomo import read_scan
from holosplat.io.volumes import read_volume
from holosplat.methods.presets import read_method
from holosplat.tables import to_table
from holosplat.workflows.reconstruct import load_reconstruction
from holosplat.workflows.run_folder import RunFolder

DATA = Path(__file__).resolve().parents[1] / "data"
SCAN = DATA / "run_0_1_0_scan.nxs"
MATERIAL = (7.414961917792018e-07, 2.648627065928879e-10)


@pytest.fixture
def run(tmp_path) -> Path:
    """A copy of the run."""
    return shutil.copytree(DATA / "run_0_1_0", tmp_path / "run")


def test_the_cloud_and_what_is_said_of_it_are_read(run):
    found = load_reconstruction(RunFolder(run))
    assert (found.object.kind, found.object.described) == ("gaussians", "164 Gaussians")
    assert (found.object.matter.single, tuple(found.object.matter.channels[0])) == (True, MATERIAL)
    assert (found.method, found.oversample, found.energy_kev, found.finished) == ("gaussians", 2, 20.0, True)
    assert set(found.timing) == {"start", "fit"}
    assert len(RunFolder(run).history()["loss"]) == 20


def test_frames_and_volume_are_those_of_version_0_1_0(run, tmp_path):
    """Numbers that version 0.1.0 computed with its own code, of the held-out frame and of δ."""
    worked(holosplat("render", run, "--scan", SCAN, "--out", tmp_path / "p.nxs"))
    (frame,) = read_scan(tmp_path / "p.nxs").frames.astype(float)
    found = (frame.mean(), frame.std(), frame.min(), frame.max(), frame[9, 13], frame[4, 7])
    assert found == pytest.approx((0.9998219636, 0.01583613363, 0.9224766, 1.042754, 0.9354315, 1.0145534), abs=2e-6)
    worked(holosplat("export", run, "--volume", tmp_path / "v.h5"))
    volume = read_volume(tmp_path / "v.h5")
    assert volume.grid == Grid.of_views(read_scan(SCAN).views)
    delta = volume.delta.astype(float)
    assert delta.sum() == pytest.approx(0.0005728539546, rel=1e-5)
    assert np.unravel_index(delta.argmax(), delta.shape) == (12, 9, 7)
    centre = [float((delta * axis).sum() / delta.sum()) for axis in np.indices(delta.shape)]
    assert centre == pytest.approx([12.85666937, 8.472318296, 11.19945260], rel=1e-5)


def test_it_is_evaluated_and_reported(run):
    """The scores are those that version 0.1.0 printed; it takes the scan for the one that was reconstructed."""
    done = worked(holosplat("evaluate", run, "--scan", SCAN))
    assert "held-out frames: SSIM 0.3900, FRCM 0.5715, PSNR 21.4 dB, L1 0.04040" in done.out
    assert "training frames: SSIM 0.5118, FRCM 0.7435" in done.out
    assert "material: δ 7.415e-07, δ/β 2800 (one for all)" in done.out
    assert "not the scan" not in done.err
    page = (run / "report.html").read_text()
    assert "Gaussian reconstruction, one material, known" in page
    assert "fit.schedule.rate_position" in page


def test_surfaces_are_cut_out_of_it(run, tmp_path):
    done = worked(holosplat("surface", run, "--scan", SCAN, "--out", tmp_path / "bodies", "--steps", 2))
    assert "2 bodies of" in done.err


@pytest.mark.usefixtures("unjudged_runs")
def test_its_settings_run_today(run, tmp_path):
    options = ["--config", run / "config.json", "--material", "haemoglobin", "--seed", 7]
    worked(holosplat("reconstruct", SCAN, "--out", tmp_path / "new", *options))
    config = json.loads((tmp_path / "new/config.json").read_text())
    assert config["method"] == to_table(read_method(run / "config.json"))
    assert config["method"]["fit"]["rates"]["centres"] == 0.01
    old, new = (load_reconstruction(RunFolder(folder)).object for folder in (run, tmp_path / "new"))
    assert new.described == old.described
    a, b = (obj.voxelise(Grid.of_views(read_scan(SCAN).views)).delta for obj in (old, new))
    assert np.linalg.norm(a - b) < 2.5e-3 * np.linalg.norm(a)  # phase retrieval begins otherwise


def test_it_is_not_resumed(run, tmp_path):
    before = everything_in(run)
    options = ["--config", run / "config.json", "--material", "haemoglobin", "--seed", 7, "--resume"]
    outcome = holosplat("reconstruct", SCAN, "--out", run, *options)
    refused(outcome, str(run), "schema 1", "start anew into another --out", "--config")
    assert "phase retrieval" not in outcome.err
    assert everything_in(run) == before


def test_without_its_cloud_it_is_no_run(run):
    (run / "gaussians.h5").unlink()
    refused(holosplat("evaluate", run, "--scan", SCAN), "must hold a reconstruction")
