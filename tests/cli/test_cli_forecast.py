"""`forecast` on the command line: from a run of the first times of a scan to the later ones, which judge it."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path

import numpy as np
import pytest

import holosplat as hs
import holosplat.cli.forecast as acting
import holosplat.cli.track as command
import holosplat.workflows.forecast as forecasts
import holosplat.workflows.track as workflow
from helpers.cli import Outcome, holosplat, refused, worked
from helpers.moving_ellipsoids import MATERIAL, PIXEL, STEP, ellipsoid, scan
from helpers.pictures import undrawn
from holosplat.io.nxtomo import read_scan, write_scan
from holosplat.io.objects import read_object
from holosplat.io.paraview import read_pvd
from holosplat.matter import Matter
from holosplat.motion.measures import half_sets
from holosplat.motion.track import Followed
from holosplat.representations import MovingSurfaces, TimeBasis
from holosplat.specimens.red_cells import icosphere
from holosplat.workflows.forecast import read_band, read_forecast
from holosplat.workflows.reconstruction import write_rest
from holosplat.workflows.run_folder import RunFolder

AHEAD, TIMES = 2, 10
"""Of the times of the scan the first is before the run, and the last after it."""
SHORT = ("--effort", 0.1)


def worked_by(*arguments: object) -> Outcome:
    return worked(holosplat(*arguments))


def on_true_paths(train: hs.Scan, *_: object, **__: object) -> Followed:
    """What a perfect fit would give: the bodies on parabolas through their places at the times of the frames."""
    times = train.instants
    basis = TimeBasis(float(times[0]), float(times[-1]), 2)
    places = [np.array([ellipsoid(k, time / STEP - 0.5 * (TIMES - 1), 2).vertices for time in times]) for k in range(3)]
    paths, faces = [basis.fitted(times, one) for one in places], [icosphere(2)[1]] * 3
    bodies = MovingSurfaces.of_bodies(paths, faces, basis, PIXEL, Matter.one(*MATERIAL))
    return Followed(bodies, [], 2, {"soft fit": 0.0}, (3,) * len(times))


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """The scan, a run of all times but the last, and its forecast of that and one more."""
    folder = tmp_path_factory.mktemp("forecast")
    write_scan(folder / "scan.nxs", scan(times=TIMES))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(workflow, "follow", on_true_paths)
        patch.setattr(command, "report_run", lambda folder, *_: folder.report)  # a second one says no more
        how = ("--material", "haemoglobin", "--time-frames", f"1:{TIMES - 1}")
        worked_by("track", folder / "scan.nxs", *how, "--out", folder / "run")
    with undrawn(), pytest.MonkeyPatch.context() as patch:
        patch.setattr(forecasts, "half_sets", seen_by_halves)
        worked_by("forecast", folder / "run", "--times", AHEAD, *SHORT, "--out", folder / "later")
    return folder


SEEN = list[np.ndarray]()
"""Times of the frames of each pair of halves."""


def seen_by_halves(train: hs.Scan, *others: object, **named: object) -> object:
    SEEN.append(train.instants)
    return half_sets(train, *others, **named)  # type: ignore[arg-type]


def test_halves_are_of_the_run_and_of_its_first_two_thirds(folder):
    """Times of the scan before those of the run are not in them."""
    whole, early = SEEN
    assert whole == pytest.approx(STEP * np.arange(1, TIMES - 1))
    assert early == pytest.approx(whole[:6])


def test_without_half_sets_nothing_is_said_of_errors(folder):
    """The scan's later frames that the run judges are those within the forecast."""
    out = folder / "alone"
    with undrawn():
        said = worked_by(
            "forecast", folder / "run", "--no-half-sets", "--times", 2, "--step", 0.512345678901 * STEP, "--out", out
        )
    assert "standard error of surfaces: not told" in said.out
    assert "nothing else was asked, for that needs half-sets" in said.out
    page = (out / "report.html").read_text()
    assert "This is a forecast of the time" in page
    assert "of the reconstruction</small>" not in page
    times, band = read_band(RunFolder(out))
    assert np.isnan(band).all()
    assert times == pytest.approx(json.loads((out / "forecast.json").read_text())["times_s"], rel=1e-12, abs=0)
    assert json.loads((out / "source.json").read_text())["reading"]["time_frames"] == f"{TIMES - 1}:{TIMES}"
    assert json.loads((out / "config.json").read_text())["method"]["forecast"] == "auto"


def test_only_the_first_times_are_tracked(folder):
    summary = json.loads((folder / "run" / "summary.json").read_text())
    assert summary["times_s"] == pytest.approx(STEP * np.arange(1, TIMES - 1))


def test_bodies_go_on_with_a_band(folder):
    later = folder / "later"
    wanted = STEP * (TIMES - 1 + np.arange(AHEAD))
    assert [step.time for step in read_pvd(later / "bodies.pvd")] == pytest.approx(wanted)
    with (later / "tracks.csv").open() as file:
        assert [float(row["time_s"]) for row in csv.DictReader(file)] == pytest.approx(np.repeat(wanted, 3))
    with (later / "forecast.csv").open() as file:
        errors = np.array([float(row["standard_error_m"]) for row in csv.DictReader(file)]).reshape(AHEAD, 3)
    assert (errors[1] > errors[0]).all()
    before, after = (read_object(folder / name / "object.h5") for name in ("run", "later"))
    assert isinstance(before, MovingSurfaces)
    assert isinstance(after, MovingSurfaces)
    for ours, theirs in zip(after.bodies(wanted[0] - STEP), before.bodies(wanted[0] - STEP)):
        assert ours.vertices == pytest.approx(theirs.vertices, abs=0.3e-6)  # of 3 to 5 µm, that move 2 µm a step
    page = (later / "report.html").read_text(encoding="utf-8")
    assert "surface along its normals, root mean square over it" in page
    assert "similarity of predicted frames with 1 that the run did not see" in page


def test_frames_that_were_held_out_judge_it(folder):
    """Better than bodies that stay; the frames predicted are those of its bodies."""
    (judged,) = json.loads((folder / "later" / "forecast.json").read_text())["held_out"]
    assert judged["time_s"] == pytest.approx(STEP * (TIMES - 1))
    assert judged["ssim"] > judged["ssim_still"] + 0.1
    worked_by(
        "render",
        folder / "later",
        "--scan",
        folder / "later" / "forecast.nxs",
        "--split",
        "train",
        "--out",
        folder / "again.nxs",
    )
    assert read_scan(folder / "again.nxs").frames == pytest.approx(
        read_scan(folder / "later" / "forecast.nxs").frames, abs=1e-5
    )
    said = json.loads(worked_by("evaluate", folder / "later", "--json").out)
    assert said["train"]["mean"]["ssim"] == pytest.approx(judged["ssim"], abs=0.05)


def test_a_forecast_is_not_scored_by_its_own_predictions(folder, tmp_path):
    """Of times of which the scan has no frames."""
    with undrawn():
        how = ("--no-half-sets", "--times", 1, "--step", 0.1 * STEP, "--out", tmp_path / "beyond")
        worked_by("forecast", folder / "run", *how)
    refused(holosplat("evaluate", tmp_path / "beyond"), "only its own predictions", "--truth")
    worked_by("export", folder / "run", "--volume", tmp_path / "truth.h5")
    said = json.loads(worked_by("evaluate", tmp_path / "beyond", "--truth", tmp_path / "truth.h5", "--json").out)
    assert said["train"] is None
    assert said["volume"] is not None


def test_a_run_of_several_times_is_not_rehearsed(folder):
    refused(holosplat("rehearse", folder / "run"), "matter at one time", "several")
    assert "rehearse" not in worked_by("info", folder / "run").out
    assert "No rehearsal" not in (folder / "later" / "report.html").read_text(encoding="utf-8")


def test_a_forecast_that_was_cut_off_goes_on(folder, monkeypatch):
    """--resume alone gives the same bodies, and refuses the folder of another run."""
    out = folder / "again"

    def cut_off(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(acting, "carry_on", cut_off)
        said = holosplat("forecast", folder / "run", "--times", AHEAD, *SHORT, "--out", out).err
    assert "go on with --resume" in said
    refused(holosplat("forecast", folder / "run", "--times", 1, "--out", out, "--resume"), "--resume needs the")
    with undrawn():
        worked_by("forecast", "--resume", out)
    assert (out / "tracks.csv").read_bytes() == (folder / "later" / "tracks.csv").read_bytes()


def test_what_cannot_be_carried_on_is_refused(folder):
    run, out = folder / "run", folder / "none"
    refused(holosplat("forecast", run, "--times", 0, "--out", out), "--times", "at least 1")
    refused(holosplat("forecast", run, "--step", 0, "--out", out), "--step")
    refused(holosplat("forecast", run, "--degree", 0, "--out", out), "degree")
    refused(holosplat("forecast", run, "--out", folder / "later"), "later")
    refused(holosplat("forecast", run, "--by", "mechanics", "--out", out), "--by mechanics", "--channel")
    refused(holosplat("forecast", run, "--by", "graph", "--out", out), "up to 1.2 windows", "--by paths")
    refused(holosplat("forecast", run, "--weights", folder / "scan.nxs", "--out", out), "scan.nxs", "safetensors file")
    refused(holosplat("forecast", run, "--by", "sindy", "--out", out), "9 times at least", "--by paths")
    refused(holosplat("forecast", run, "--by", "paths", "--weights", "x", "--out", out), "--weights needs --by auto")
    refused(holosplat("forecast", run, "--by", "dmd", "--channel", 1, 1, "--out", out), "--channel needs", "mechanics")
    refused(holosplat("forecast", run, "--by", "graph", "--degree", 3, "--out", out), "--degree needs")
    refused(holosplat("forecast", run, "--shear-modulus", 1e-6, "--out", out), "--shear-modulus needs --channel")
    refused(holosplat("forecast", run, "--no-half-sets", "--effort", 2, "--out", out), "--effort needs --half-sets")
    through = ("forecast", run, "--out", out, "--channel", "1e-5", "1e-5")
    refused(holosplat(*through), "within the channel", "--flow-axis")
    refused(holosplat(*through, "--peak", "0.2:0.1"), "--peak", "LOW:HIGH")
    refused(holosplat(*through, "--shear-modulus", "soft"), "--shear-modulus")
    refused(holosplat("forecast", folder, "--out", out), "must hold a reconstruction")
    assert not out.exists()


def test_later_frames_correct_a_forecast(folder):
    """Frames that the forecast itself predicts leave its bodies where they are, with their numbers."""
    frames, out = folder / "later" / "forecast.nxs", folder / "corrected"
    how = ("--material", "haemoglobin", "--rounds", 0, "--effort", 0.1, "--after", folder / "later", "--out", out)
    with undrawn():
        said = worked_by("track", frames, *how)
    assert "standard errors of the forecast" in said.out
    summary = json.loads((out / "summary.json").read_text())
    assert summary["bodies"] == 3
    assert summary["moved_from_forecast"] < 0.5
    assert "after" in json.loads((out / "config.json").read_text())
    bodies = [read_object(folder / name / "object.h5") for name in ("corrected", "later")]
    for ours, theirs in zip(*(of.bodies(STEP * (TIMES - 1)) for of in bodies if isinstance(of, MovingSurfaces))):
        assert ours.vertices.mean(0) == pytest.approx(theirs.vertices.mean(0), abs=0.1 * PIXEL)


def test_a_forecast_keeps_the_shape_at_rest(folder):
    """That of the run, which then holds for the frames that correct it."""
    run, out, shape = folder / "of known shape", folder / "shaped", ellipsoid(0, 0.0, 2)
    shutil.copytree(folder / "run", run)
    write_rest(RunFolder(run), shape)
    with undrawn():
        worked_by("forecast", run, "--times", 1, "--by", "paths", *SHORT, "--out", out)
    kept = read_forecast(RunFolder(out)).rest
    assert kept is not None
    assert PIXEL * kept.elastic.membrane.mesh.vertices == pytest.approx(shape.vertices, abs=1e-11)
    assert read_forecast(RunFolder(folder / "later")).rest is None


def test_only_a_forecast_that_reaches_over_the_frames_is_taken(folder):
    out, unsure = folder / "none", folder / "unsure"
    how = ("--material", "haemoglobin", "--out", out)
    scan, times = folder / "scan.nxs", ("--time-frames", f"{TIMES - 2}:{TIMES}")
    refused(holosplat("track", scan, *how, "--after", folder / "run"), "a folder that holosplat forecast wrote")
    refused(holosplat("track", scan, *times, *how, "--after", folder / "later"), "must reach over the times")
    shutil.copytree(folder / "later", unsure)
    rows = [row.split(",") for row in (unsure / "forecast.csv").read_text().splitlines()]
    unknown = (",".join([*row[:2], "nan" if k else row[2]]) for k, row in enumerate(rows))
    (unsure / "forecast.csv").write_text("\n".join(unknown))
    frames = unsure / "forecast.nxs"
    refused(holosplat("track", frames, *how, "--after", unsure), "must have standard errors", "--half-sets")
    assert not out.exists()
