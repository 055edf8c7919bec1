"""Windows of a series whose times are taken together, as is asked or as their frames choose."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from helpers.cli import QUICK, holosplat, worked
from helpers.series import SETTINGS, planned
from holosplat.inference import Decision
from holosplat.io.atomic import read_json
from holosplat.io.volumes import read_volume
from holosplat.motion.track import TrackOptions
from holosplat.series import task
from holosplat.series.collect import collect
from holosplat.series.folder import SeriesFolder
from holosplat.series.run import run_left
from holosplat.tables import read_rows
from holosplat.workflows.run_folder import RunFolder

AUTO = replace(SETTINGS, act="auto")


@pytest.fixture
def chosen(monkeypatch):
    """The windows that were asked; the first is still, and others are taken time by time."""
    asked = []

    def choose(scan, prior, method, seed, **how):
        asked.append(scan)
        assert method == QUICK
        assert how["bodies"] == TrackOptions()
        return Decision("motion", "still" if len(asked) == 1 else "each", "times set aside")

    monkeypatch.setattr(task, "choose_motion", choose)
    monkeypatch.setattr(task, "FEWEST", 2)
    return asked


@pytest.mark.usefixtures("unjudged_runs")
def test_each_window_is_taken_as_its_frames_choose(files, tmp_path, chosen):
    """Once, though its task goes on later; a time that is alone by itself. Each has its row, verdict and volume."""
    folder = planned(tmp_path / "series", files.scan, settings=AUTO)
    run_left(folder)
    assert [len(scan.instants) for scan in chosen] == [2, 2]
    rows = read_rows(collected(folder), "")
    assert [row["run"].split("/")[-1] for row in rows] == ["run", "run", "t0002", "t0003", "t0004"]
    assert [row["decided"] for row in rows[:2]] == [Decision("motion", "still", "times set aside").line] * 2
    judged = read_rows(folder.whole(0) / "times.csv", "")
    assert [(row["explained"], row["verdict"]) for row in rows[:2]] == [(e["explained"], e["verdict"]) for e in judged]
    assert [row["begun"] for row in rows[2:]] == ["cold", rows[3]["begun"], "cold"]
    out = tmp_path / "v.h5"
    worked(holosplat("export", folder.path, "--volume", out, "--time-frame", "all"))
    first, second, third = (read_volume(tmp_path / f"v_t{k:04d}.h5").delta for k in range(3))
    np.testing.assert_array_equal(first, second)
    assert not np.array_equal(second, third)
    (folder.task(0) / "done.json").unlink()
    folder.row(0, 1).unlink()
    run_left(folder)
    assert len(chosen) == 2


def collected(folder: SeriesFolder):
    collect(folder)
    return folder.table


@pytest.mark.usefixtures("unjudged_runs")
def test_a_still_window_is_one_run_of_all_its_frames(files, tmp_path):
    """Which the run knows again: it is evaluated as it was found."""
    folder = planned(tmp_path / "series", files.scan, 5, replace(SETTINGS, act="still"))
    run_left(folder)
    run = RunFolder(folder.whole(0))
    assert read_json(run.source)["time_frame"] == "still"
    again = worked(holosplat("evaluate", run.path))
    assert "not the scan that was reconstructed" not in again.out + again.err
    (line,) = [line for line in again.out.splitlines() if line.startswith("training frames")]
    assert "SSIM" in line
    rows = read_rows(collected(folder), "")
    assert len({row["total_m3"] for row in rows}) == 1
