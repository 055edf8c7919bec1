"""`holosplat reconstruct --time-frame each`: a series of all times, made by one command."""

from __future__ import annotations

import csv
import json

import pytest

from helpers.cli import QUICK, everything_in, holosplat, refused, worked
from helpers.series import TIMES
from holosplat.series import run
from holosplat.series.folder import SeriesFolder
from holosplat.tables import to_table
from holosplat.workflows.reconstruct import load_reconstruction
from holosplat.workflows.run_folder import RunFolder


@pytest.fixture
def known(tmp_path):
    (tmp_path / "quick.json").write_text(json.dumps(to_table(QUICK)))
    return ["--material", "haemoglobin", "--matter", "levels", "--config", tmp_path / "quick.json"]


def test_each_time_begins_with_the_one_before(files, known, tmp_path):
    """Runs, rows and page; then nothing is left, and other options or questions are refused, with nothing changed."""
    asked = ["reconstruct", files.scan, *known, "--time-frame", "each", "--out", tmp_path / "out"]
    said = worked(holosplat(*asked)).err
    folder = SeriesFolder(tmp_path / "out")
    rows = list(csv.DictReader(folder.table.read_text().splitlines()))
    assert [row["begun"] for row in rows] == ["cold"] + ["warm"] * (TIMES - 1)
    assert f"time {TIMES - 1}: warm" in said
    assert folder.page.is_file()
    for k in range(TIMES):
        assert load_reconstruction(RunFolder(folder.run(0, k))).finished
    before = everything_in(tmp_path)
    refused(holosplat(*asked), "must be new or empty")
    refused(holosplat(*asked, "--resume", "--seed", 3), "of the same scan and options")
    refused(holosplat(*asked, "--resume", "--refine", "shifts"), "--refine is of one time")
    refused(holosplat(*asked, "--resume", "--strict"), "--strict are of one time")
    refused(holosplat(*asked, "--resume", "--delta-beta", "100:200"), "one number for each constant")
    refused(
        holosplat("evaluate", folder.run(0, 0), "--scan", files.scan, "--time-frame", "each"), "each is of reconstruct"
    )
    assert everything_in(tmp_path) == before


def test_what_was_cut_off_goes_on(files, known, tmp_path, monkeypatch):
    """Ctrl-C at the third time; the first two are not done again."""
    asked = ["reconstruct", files.scan, *known, "--time-frame", "each", "--out", tmp_path / "out"]
    task = run.run_task

    def broken_off(folder, number, on_row):
        def tell(row):
            on_row(row)
            if row.number == 1:
                raise KeyboardInterrupt

        return task(folder, number, tell)

    with monkeypatch.context() as patch:
        patch.setattr(run, "run_task", broken_off)
        outcome = holosplat(*asked)
    assert outcome.code == 130
    assert "--resume" in outcome.err
    again = worked(holosplat(*asked, "--resume")).err
    assert "time 1:" not in again
    assert f"time {TIMES - 1}: warm" in again
