"""`holosplat reconstruct`, `render`, `export` and `evaluate`: what runs hold, and interruption."""

from __future__ import annotations

import contextlib
import json
import re
import shutil
import signal
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from helpers.cli import COLUMNS, PIXEL, QUICK, ROWS, holosplat, known, refused, worked
from holosplat.cli.progress import ProgressBar
from holosplat.fit.problem import Schedule
from holosplat.fit.run import Run
from holosplat.geometry import Grid
from holosplat.io.nxtomo import read_scan, write_scan
from holosplat.io.volumes import read_volume
from holosplat.materials import HAEMOGLOBIN, PLASMA, RED_CELL
from holosplat.tables import to_table
from holosplat.workflows.evaluate import evaluate, render
from holosplat.workflows.reconstruct import load_reconstruction
from holosplat.workflows.run_folder import RunFolder

pytestmark = pytest.mark.usefixtures("unjudged_runs")


def test_a_run_knows_its_material_seed_and_settings(shop):
    config = json.loads((shop.run / "config.json").read_text())
    material = HAEMOGLOBIN.delta_beta(20)
    assert config["prior"] == {"kind": "known", "delta": material.delta, "beta": material.beta, "ratio": 0.0}
    assert config["seed"] == 5
    assert config["method"] == to_table(QUICK)


@pytest.mark.parametrize(("options", "kind"), [([], "free"), (["--delta-beta", "2800"], "ratio")])
def test_less_may_be_known_of_the_matter(shop, tmp_path, options, kind):
    out = tmp_path / "run"
    outcome = worked(holosplat("reconstruct", shop.scan, "--out", out, "--config", shop.quick, *options))
    assert json.loads((out / "config.json").read_text())["prior"]["kind"] == kind
    assert re.search(r"material: δ \d\.\d+e-07, δ/β \d+", outcome.out)


def test_a_medium_belongs_to_the_material(shop, tmp_path):
    out = tmp_path / "run"
    matter = ["--material", "red cell", "--medium", "plasma"]
    worked(holosplat("reconstruct", shop.scan, "--out", out, "--config", shop.quick, *matter))
    contrast = RED_CELL.delta_beta(20).against(PLASMA.delta_beta(20))
    prior = json.loads((out / "config.json").read_text())["prior"]
    assert (prior["delta"], prior["beta"]) == pytest.approx(contrast, rel=1e-9, abs=0)


@pytest.mark.parametrize(("split", "chosen"), [("test", [3, 7]), ("train", [0, 1, 2, 4, 5, 6]), ("all", range(8))])
def test_rendered_frames_are_in_the_scans_order_and_layout(shop, tmp_path, split, chosen):
    out = tmp_path / "predicted.nxs"
    options = [] if split == "test" else ["--split", split]
    worked(holosplat("render", shop.run, "--scan", shop.scan, "--out", out, *options))
    measured, predicted = read_scan(shop.scan)[list(chosen)], read_scan(out)
    np.testing.assert_array_equal(predicted.views.rotations, measured.views.rotations)
    np.testing.assert_array_equal(predicted.is_test, measured.is_test)
    np.testing.assert_array_equal(predicted.exposures.distance, measured.exposures.distance)
    assert set(predicted.exposures.energy_kev) == set(measured.exposures.energy_kev)
    wanted = render(load_reconstruction(RunFolder(shop.run)), measured.exposures)
    np.testing.assert_allclose(predicted.frames, wanted, rtol=0, atol=1e-6)
    errors = [[np.abs(p - m).mean() for m in measured.frames] for p in predicted.frames]
    assert np.argmin(errors, axis=1).tolist() == list(range(len(chosen)))


def test_an_exported_volume_is_the_fields_or_as_asked(shop, tmp_path):
    cloud = load_reconstruction(RunFolder(shop.run)).object
    for number, (options, grid) in enumerate(
        (
            ([], Grid.centred((COLUMNS, ROWS, COLUMNS), PIXEL)),
            (["--shape", 10, 12, 14, "--voxel-size", 5e-6], Grid.centred((10, 12, 14), 5e-6)),
            (["--shape", 10, 12, 14], Grid.centred((10, 12, 14), PIXEL)),
        )
    ):
        out = tmp_path / f"volume{number}.h5"
        worked(holosplat("export", shop.run, "--volume", out, *options))
        volume = read_volume(out)
        assert volume.grid.shape == grid.shape
        np.testing.assert_allclose(volume.grid.voxel_size, grid.voxel_size)
        np.testing.assert_allclose(volume.grid.origin, grid.origin, rtol=1e-12)
        np.testing.assert_array_equal(volume.delta, cloud.voxelise(grid).delta)
        np.testing.assert_array_equal(volume.beta, cloud.voxelise(grid).beta)


def test_scores_are_those_of_the_python_api(shop):
    result, scan = load_reconstruction(RunFolder(shop.run)), read_scan(shop.scan)
    wanted = evaluate(result, scan, read_volume(shop.truth))
    report = shop.run / "report.html"
    report.unlink()
    outcome = worked(holosplat("evaluate", shop.run, "--truth", shop.truth, "--json"))
    assert json.loads(outcome.out) == json.loads(json.dumps(wanted.as_dict()))
    assert report.is_file()
    table = worked(holosplat("evaluate", shop.run, "--scan", shop.scan, "--truth", shop.truth))
    assert table.out.splitlines() == wanted.lines()


def test_another_scan_is_scored_but_does_not_enter_the_report(shop, tmp_path):
    """Its held-out frames may be some that were fitted: a line says so."""
    scan = read_scan(shop.scan)
    write_scan(tmp_path / "other.nxs", replace(scan, is_test=~scan.is_test))
    before = (shop.run / "report.html").read_bytes()
    outcome = worked(holosplat("evaluate", shop.run, "--scan", tmp_path / "other.nxs", "--truth", shop.truth))
    assert "held-out frames: SSIM" in outcome.out
    assert "not the scan" in outcome.err
    assert (shop.run / "report.html").read_bytes() == before


def test_a_run_finds_its_scan_or_asks_for_it(shop, tmp_path):
    """From any folder; and where the scan was moved away, it can be named."""
    scan, run = Path(shutil.copy(shop.scan, tmp_path)), tmp_path / "run"
    shutil.copytree(shop.run, run)
    (run / "source.json").write_text(json.dumps({"scan": str(scan)}))
    worked(holosplat("evaluate", run))
    scan.rename(tmp_path / "moved.nxs")
    refused(holosplat("evaluate", run), "scan.nxs", "--scan")
    worked(holosplat("evaluate", run, "--scan", tmp_path / "moved.nxs"))
    (run / "source.json").unlink()  # as in runs made from Python
    refused(holosplat("evaluate", run), str(run), "--scan")


def test_ctrl_c_leaves_a_usable_run_that_goes_on(shop, tmp_path):
    """Exit code 130, a result and its report; --resume ends the fit."""
    long = replace(QUICK, fit=replace(QUICK.fit, schedule=Schedule(steps=200)))
    (tmp_path / "long.json").write_text(json.dumps(to_table(long)))
    known_to_have_levels = ["--material", "haemoglobin", "--matter", "levels"]
    arguments = ["reconstruct", shop.scan, "--out", "run", *known_to_have_levels, "--config", "long.json"]
    show = ProgressBar.show

    def press(bar: ProgressBar, stage: str, fraction: float, record: dict[str, float]) -> None:
        show(bar, stage, fraction, record)
        if stage == "fit" and fraction > 0.1:
            signal.raise_signal(signal.SIGINT)

    with contextlib.chdir(tmp_path), pytest.MonkeyPatch.context() as patch:
        patch.setattr(ProgressBar, "show", press)
        ended = holosplat(*arguments)
    assert ended.code == 130
    assert "Traceback" not in ended.err
    assert "--resume" in ended.err
    assert "held-out frames" in ended.out
    summary = json.loads((tmp_path / "run/summary.json").read_text())
    assert (summary["finished"], 0 < summary["steps"] < 200) == (False, True)
    assert (tmp_path / "run/report.html").is_file()
    worked(holosplat("evaluate", tmp_path / "run"))
    other = holosplat("reconstruct", shop.scan, "--out", tmp_path / "run", *known(shop), "--resume")
    refused(other, "--resume", "settings")
    before = json.loads((tmp_path / "run/summary.json").read_text())["steps"]
    with contextlib.chdir(tmp_path):
        outcome = worked(holosplat(*arguments, "--resume"))
    assert before == summary["steps"]
    assert "phase retrieval" not in outcome.err
    assert json.loads((tmp_path / "run/summary.json").read_text())["finished"] is True


def test_ctrl_c_during_the_start_leaves_nothing(shop, tmp_path, monkeypatch):
    def pressed(*arguments: object, **options: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("holosplat.workflows.reconstruct.reconstruct", pressed)
    outcome = holosplat("reconstruct", shop.scan, "--out", tmp_path / "run", *known(shop))
    assert outcome.code == 130
    assert outcome.err.strip().splitlines()[-1] == "interrupted; nothing was kept yet, so begin anew"
    assert list(tmp_path.iterdir()) == []


def test_ctrl_c_between_fits_says_how_the_run_goes_on(shop, tmp_path):
    keep = Run.keep

    def pressed(run: Run) -> None:
        keep(run)
        raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Run, "keep", pressed)
        outcome = holosplat("reconstruct", shop.scan, "--out", tmp_path / "run", *known(shop))
    assert outcome.code == 130
    assert outcome.err.strip().splitlines()[-1] == f"interrupted; go on with --resume {tmp_path / 'run'}"
    assert f"holosplat reconstruct --resume {tmp_path / 'run'}" in worked(holosplat("info", tmp_path / "run")).out
    worked(holosplat("reconstruct", "--resume", tmp_path / "run"))
