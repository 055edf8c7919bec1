"""`holosplat reconstruct --time-frame all`: matter in motion, and what the other commands make of such a run."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from helpers.cli import holosplat, worked
from helpers.short import FLOW
from holosplat.cli import forecast as forecasting
from holosplat.cli import scans
from holosplat.cli import track as motion
from holosplat.fit.run import Run
from holosplat.io.nxtomo import read_scan
from holosplat.io.reading import Reading
from holosplat.io.volumes import read_volume
from holosplat.matter import DeltaBeta, MaterialPrior
from holosplat.optics.background import LightOptions
from holosplat.representations import MovingGaussians
from holosplat.tables import read_rows
from holosplat.workflows.reconstruct import load_reconstruction
from holosplat.workflows.run_folder import RunFolder
from holosplat.workflows.track import reconstruct_moving
from holosplat_bench.opponents.fields import SpaceTimeField

pytestmark = pytest.mark.usefixtures("unjudged_runs")


@pytest.fixture
def quick(monkeypatch, tmp_path):
    """A series of three times, fitted in few steps, without the report's drawing."""

    def few(scan, prior, options, *rest, **others):
        return reconstruct_moving(scan, prior, replace(FLOW, fading=options.fading), *rest, ask=False, **others)

    monkeypatch.setattr(motion, "reconstruct_moving", few)

    def report(*what):
        (tmp_path / "remark").write_text(what[-1], encoding="utf-8")
        return tmp_path / "run/report.html"

    monkeypatch.setattr(scans, "report_run", report)
    blob = ["--specimen", "stirred-blob", "--material", "PMMA", "--specimen-motion", 40, "--frame-rate", 1e3]
    field = ["--frames", 3, "--detector", 15, 19, "--pixel-size", "1e-6", "--distance", 0.1, "--views", 3]
    truth = ["--photons-per-pixel", 2000, "--test-every", 0, "--truth", tmp_path / "t.h5", "--truth-frames", 0, 2]
    worked(holosplat("simulate", *blob, *field, *truth, "--out", tmp_path / "s.nxs"))
    return tmp_path


def test_a_series_in_motion_is_one_object_that_all_commands_read(quick):
    known = ["--material", "PMMA", "--time-frame", "all"]
    said = worked(holosplat("reconstruct", quick / "s.nxs", *known, "--out", quick / "run"))
    assert "carried by a flow" in said.err
    found = load_reconstruction(RunFolder(quick / "run"))
    assert isinstance(found.object, MovingGaussians)
    assert "time 1000 µs, of 9 frames of 3 times" in (quick / "remark").read_text(encoding="utf-8")
    summary = json.loads((quick / "run/summary.json").read_text())
    assert summary["times_s"] == pytest.approx([0, 1e-3, 2e-3], abs=0)
    rows = read_rows(quick / "run/times.csv", "")
    assert [float(row["time_s"]) for row in rows] == pytest.approx([0, 1e-3, 2e-3], abs=0)
    assert {row["explained"] for row in rows} <= {"0", "1"}
    assert "of 3 times are " in said.out
    worked(holosplat("export", quick / "run", "--volume", quick / "v.h5", "--time-frame", "all"))
    volumes = [read_volume(quick / f"v_t000{k}.h5").delta for k in range(3)]
    assert np.abs(volumes[2] - volumes[0]).max() > 0.01 * volumes[0].max()
    scored = worked(holosplat("evaluate", quick / "run", "--truth", quick / "t_t0002.h5", "--time-frame", 2, "--json"))
    assert json.loads(scored.out)["relative_error_delta"] < 0.8
    worked(holosplat("render", quick / "run", "--scan", quick / "s.nxs", "--split", "train", "--out", quick / "p.nxs"))
    assert len(read_scan(quick / "p.nxs")) == 9
    refused = holosplat("export", quick / "run", "--bodies", quick / "b")
    assert refused.code == 2


def test_a_run_that_was_cut_off_goes_on(quick, monkeypatch):
    """Ctrl-C after two steps; the same command with --resume ends it, one with another seed is refused."""
    asked = ["reconstruct", quick / "s.nxs", "--material", "PMMA", "--time-frame", "all", "--out", quick / "run"]
    keep, kept = Run.keep, list[int]()

    def broken_off(run):
        keep(run)
        kept.append(1)
        if len(kept) == 2:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(Run, "keep", broken_off)
        outcome = holosplat(*asked)
    assert outcome.code == 130
    assert "--resume" in outcome.err
    assert holosplat(*asked, "--resume", "--seed", 3).code == 2
    assert holosplat("evaluate", quick / "run").code == 2  # not finished
    worked(holosplat(*asked, "--resume"))
    assert isinstance(load_reconstruction(RunFolder(quick / "run")).object, MovingGaussians)


def test_matter_may_fade(quick):
    """The option comes to the fit and into config.json; of one time it is refused."""
    asked = ["reconstruct", quick / "s.nxs", "--material", "PMMA", "--fading", 0.3, "--out", quick / "run"]
    refused = holosplat(*asked, "--time-frame", 1)
    assert refused.code == 2
    assert "--fading is of matter that a flow carries" in refused.err
    worked(holosplat(*asked, "--time-frame", "all"))
    found = load_reconstruction(RunFolder(quick / "run")).object
    assert isinstance(found, MovingGaussians)
    assert found.fading is not None
    assert float(found.fading.abs().max()) > 1e-4
    assert json.loads((quick / "run/config.json").read_text())["method"]["fading"] == 0.3
    refused = holosplat("forecast", quick / "run", "--times", 1, "--out", quick / "none")
    assert refused.code == 2
    assert "reconstruct without --fading" in refused.err
    assert not (quick / "none").exists()


def test_two_materials_in_motion_are_refused_or_said_to_be_left(quick, capsys):
    """Bodies are refused in one sentence; continuous matter is taken as of one time, and not said to stand still."""
    two = ["--material", "PMMA", "--material", "alumina"]
    refused = holosplat("track", quick / "s.nxs", *two, "--out", quick / "none")
    assert refused.code == 2
    assert "bodies are of one material, but several are known; give --material once." in refused.err
    prior = MaterialPrior.known(DeltaBeta(8e-7, 8e-10), DeltaBeta(4e-7, 3e-10))
    how = (0, LightOptions(), FLOW)
    assert not motion.reconstruct_in_motion(quick / "s.nxs", Reading(), prior, RunFolder(quick / "none"), how)
    said = capsys.readouterr().err
    assert "a flow carries one material, but several are known" in said
    assert "nothing moves" not in said
    assert not (quick / "none").exists()


def test_matter_in_motion_is_forecast(quick, monkeypatch):
    """Judged by the frames after the run, with an error of its places; the folder is read as any other."""
    blob = ["--specimen", "stirred-blob", "--material", "PMMA", "--specimen-motion", 40, "--frame-rate", 1e3]
    field = ["--frames", 6, "--detector", 15, 19, "--pixel-size", "1e-6", "--distance", 0.1, "--views", 3]
    scan, run, later = quick / "six.nxs", quick / "run", quick / "later"
    worked(holosplat("simulate", *blob, *field, "--photons-per-pixel", 2000, "--test-every", 0, "--out", scan))
    known = ["--material", "PMMA", "--motion", "flow", "--time-frames", "0:4"]
    worked(holosplat("reconstruct", scan, *known, "--out", run))
    monkeypatch.setattr(forecasting, "report_run", lambda folder, *_: folder.report)
    said = worked(holosplat("forecast", run, "--times", 2, "--out", later))
    assert "standard error of places: 0." in said.out
    assert "how matter goes on: " in said.out
    assert "held-out frames: SSIM" in said.out
    numbers = json.loads((later / "forecast.json").read_text())
    assert numbers["times_s"] == pytest.approx([4e-3, 5e-3])
    assert [row["time_s"] for row in numbers["held_out"]] == pytest.approx([4e-3, 5e-3])
    assert [float(row["standard_error_m"]) for row in read_rows(later / "forecast.csv", "")] == pytest.approx(
        numbers["band_m"], rel=1e-3
    )
    found = load_reconstruction(RunFolder(later)).object
    assert isinstance(found, MovingGaussians)
    assert (found.basis.first, found.basis.last) == pytest.approx((3e-3, 5e-3))
    worked(holosplat("export", later, "--volume", quick / "v.h5", "--time-frame", 1))
    assert read_volume(quick / "v.h5").delta.max() > 0
    chosen = worked(holosplat("forecast", run, "--times", 1, "--by", "inertia", "--no-half-sets", "--out", quick / "i"))
    assert "standard error of places: not told" in chosen.out
    for way, why in (("rigid", "steady, inertia or paths"), ("graph", "--by must be auto, rest")):
        refused = holosplat("forecast", run, "--times", 1, "--by", way, "--out", quick / "none")
        assert refused.code == 2
        assert why in refused.err
        assert not (quick / "none").exists()
    refused = holosplat("track", scan, "--material", "PMMA", "--after", later, "--out", quick / "none")
    assert refused.code == 2


FEW = ["volume.iterations=5", "volume.retrieval=5", "volume.corrections=0", "fit.flow_steps=3", "fit.schedule.steps=3"]
"""Settings of pinn that take no time."""


def test_all_times_as_one_field_of_matter_and_velocity(quick):
    how = ["--method", "pinn", *(word for one in FEW for word in ("--set", one)), "--seed", 4]
    scan, run = quick / "s.nxs", quick / "run"
    said = worked(holosplat("reconstruct", scan, "--material", "PMMA", *how, "--time-frame", "all", "--out", run))
    assert "a field of" in said.err
    found = load_reconstruction(RunFolder(run))
    assert isinstance(found.object, SpaceTimeField)
    assert json.loads((run / "summary.json").read_text())["times_s"] == pytest.approx([0, 1e-3, 2e-3], abs=0)
    worked(holosplat("export", run, "--volume", quick / "w.h5", "--time-frame", 2))
    scored = worked(holosplat("evaluate", run, "--truth", quick / "t_t0002.h5", "--time-frame", 2, "--json"))
    assert json.loads(scored.out)["relative_error_delta"] < 1
    refused = holosplat("reconstruct", scan, "--material", "PMMA", *how, "--time-frame", 0, "--out", quick / "one")
    assert refused.code == 2
    assert "of 2 times or more" in refused.err
