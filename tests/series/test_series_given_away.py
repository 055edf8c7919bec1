"""A series, finished or not, as `info`, `export` and `run` take it."""

from __future__ import annotations

import contextlib
import json
import shutil
from dataclasses import replace

import pytest

from helpers.cli import holosplat, refused, worked
from helpers.series import TIMES, planned
from holosplat.checks import InputError
from holosplat.report.info import facts_of_series
from holosplat.series.folder import SeriesFolder, read_row, write_row
from holosplat.series.plan import Settings
from holosplat.workflows.run_folder import RunFolder


@pytest.fixture
def mine(done, tmp_path):
    """A copy of the series that is done, which a test may change."""
    return SeriesFolder(shutil.copytree(done.path, tmp_path / "series"))


def test_an_unfinished_series_is_refused_before_a_file_is_written(mine, tmp_path):
    shutil.rmtree(mine.run(1, 3))
    said = f"time 3 of {mine.path} is not done; finish it with holosplat series run {mine.path}"
    asked = ["export", mine.path, "--volume", tmp_path / "v.h5", "--time-frame"]
    refused(holosplat(*asked, "all"), said)
    refused(holosplat(*asked, 3), said)
    assert not list(tmp_path.glob("v*.h5"))
    worked(holosplat(*asked, 2))


def test_of_a_time_of_two_tasks_the_first_counts(mine):
    """As in the tables; and a verdict's sentence is one of a list."""
    bad = replace(read_row(mine.row(0, 0)), good=False, words="The frames are off above 3 µm.")
    write_row(mine.row(0, 0), bad)
    write_row(mine.row(1, 1), replace(bad, number=1))
    row = facts_of_series(mine.path).rows["verdict"]
    assert row == f"the frames of 1 of {TIMES} times are not explained, do not trust them: 0; time 0: {bad.words[:-1]}"


def test_a_finished_export_of_a_series_is_not_done_again(mine, tmp_path):
    text = f'[export]\nrun = {json.dumps(str(mine.path))}\nvolume = "v.h5"\ntime-frame = "all"\n'
    with contextlib.chdir(tmp_path):
        (tmp_path / "run.toml").write_text(text, encoding="utf-8")
        worked(holosplat("run", "run.toml"))
        assert len(list(tmp_path.glob("v_t*.h5"))) == TIMES
        assert "[export] is done" in worked(holosplat("run", "run.toml")).err


def test_a_run_of_a_window_is_named(files, tmp_path):
    folder = planned(tmp_path / "series", files.scan, 3, Settings("track"))
    run = folder.whole(0)
    assert facts_of_series(folder.path).commands[1] == f"holosplat export {folder.path} --volume v.h5 --time-frame all"
    with pytest.raises(InputError, match="whose run folders are in tasks/, but none has begun"):
        RunFolder(folder.path).require_run()
    run.mkdir(parents=True)
    (run / "config.json").write_text("{}", encoding="utf-8")
    with pytest.raises(InputError, match="as tasks/0000/run: name one"):
        RunFolder(folder.path).require_run()
