"""Tasks of a series: what they write, that nothing is done twice, and what a kill takes."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from helpers.series import moving, planned
from holosplat.checks import InputError
from holosplat.io.lock import TakenError, sole_writer
from holosplat.io.nxtomo import write_scan
from holosplat.io.objects import read_object
from holosplat.methods import HolographicVoxels
from holosplat.methods.continued import Continued
from holosplat.series import one_time as series_time
from holosplat.series import task
from holosplat.series.folder import SeriesFolder, line_of, verdict_of, write_row
from holosplat.series.plan import Settings
from holosplat.series.run import run_left, states
from holosplat.series.task import attempted, run_task
from holosplat.workflows.run_folder import RunFolder


def arrays(folder: SeriesFolder, task: int, moment: int) -> dict[str, torch.Tensor]:
    return dict(read_object(folder.run(task, moment).joinpath("object.h5")).parameters())


def same(one: dict[str, torch.Tensor], other: dict[str, torch.Tensor]) -> bool:
    return one.keys() == other.keys() and all(torch.equal(one[name], other[name]) for name in one)


@pytest.mark.parametrize("error", [MemoryError(), RuntimeError("[enforce fail] can't allocate memory: 8 bytes")])
def test_a_time_that_finds_no_memory_says_so(error):
    def fail() -> str:
        raise error

    assert attempted(fail)[1].startswith("the memory of this machine is not enough; take larger pixels")


def test_times_have_runs_and_rows(done, files):
    """The first time of a task begins by itself, the next one with what that ended with."""
    windows = done.plan().windows()
    assert [[m.number for m in w.moments] for w in windows] == [[0, 1], [2, 3], [4]]
    rows = [row for window in windows for row in done.rows(window)]
    assert [row.begun for row in rows] == ["cold", "warm", "cold", "warm", "cold"]
    assert [row.time_s for row in rows] == [0.0, 0.5, 1.0, 1.5, 2.0]
    assert all(row.done and row.good and 0 < row.test["ssim"] <= 1 for row in rows)
    config = RunFolder(done.run(0, 1)).read_config()
    assert config["method"]["kind"] == Continued.kind
    assert config["method"]["begin"] == str(done.run(0, 0).resolve() / "object.h5")
    assert not RunFolder(done.run(0, 1)).checkpoint.exists()
    phase = np.load(done.run(0, 0) / series_time.PHASE)
    assert phase.shape == (19, 23)
    assert phase.min() < -0.1
    assert json.loads((done.run(0, 1) / "source.json").read_text())["time_frame"] == 1


def test_what_is_done_is_not_done_again(done, monkeypatch):
    monkeypatch.setattr("holosplat.series.task.reconstruct_time", lambda *args: pytest.fail("it is done"))
    assert run_task(done, 1).state == "done"
    assert run_left(done).done == 3


def test_a_task_that_is_not_there(done):
    with pytest.raises(InputError, match="from 0 to 2, but 3 is asked for"):
        run_task(done, 3)


@pytest.mark.parametrize("moment", ["row", "fit"])
def test_a_kill_takes_one_time_at_most(done, files, tmp_path, moment):
    """Killed when a row is written, or in the middle of a fit: the rerun has the same numbers bit for bit."""
    folder = planned(tmp_path / "series", files.scan)
    child = os.fork()
    if child == 0:  # from here on without pytest
        torch.set_num_threads(1)
        end = lambda *args: os.kill(os.getpid(), signal.SIGKILL)  # noqa: E731
        if moment == "fit":
            RunFolder.append_metrics = lambda self, rows: end() if self.path.name == "t0001" and rows else None
        run_task(folder, 0, on_row=lambda row: end() if moment == "row" else None)
        os._exit(0)
    assert os.waitpid(child, 0)[1] == signal.SIGKILL
    window = folder.plan().windows()[0]
    state = folder.state(window)
    assert (state.state, state.times) == ("left", (1, 2))
    kept = folder.row(0, 0).read_bytes()
    assert run_task(folder, 0).state == "done"
    assert folder.row(0, 0).read_bytes() == kept
    assert same(arrays(folder, 0, 0), arrays(done, 0, 0))
    assert same(arrays(folder, 0, 1), arrays(done, 0, 1))


def test_the_work_of_another_process_is_left_to_it(done, files, tmp_path):
    folder = planned(tmp_path / "series", files.scan, window=5)
    child = os.fork()
    if child == 0:
        with sole_writer(folder.task(0)):
            os.kill(os.getpid(), signal.SIGSTOP)
        os._exit(0)
    os.waitpid(child, os.WUNTRACED)
    try:
        with pytest.raises(TakenError, match=f"process {child} on "):
            run_task(folder, 0)
        (state,) = states(folder)
        assert state.state == "running"
        assert state.writer is not None
        assert state.writer.process == child
        assert run_left(folder).running == 1
    finally:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
    assert states(folder)[0].state == "left"


def test_what_fails_is_said_and_tried_again(files, tmp_path, monkeypatch):
    """One time fails: the others are done, begun by themselves where need be; what follows is as if it never had."""
    folder = planned(tmp_path / "series", files.scan, window=3)
    real = series_time.reconstruct

    def broken(scan, *args, folder, **options):
        if folder.path.name == "t0001":
            raise ZeroDivisionError("no\nmatter here")
        return real(scan, *args, folder=folder, **options)

    monkeypatch.setattr(series_time, "reconstruct", broken)
    state = run_task(folder, 0)
    assert (state.state, state.times) == ("failed", (2, 3))
    assert state.reason == "1 of 3 times: ZeroDivisionError: matter here"
    assert run_left(folder).failed == 1  # which leaves it alone
    monkeypatch.setattr(series_time, "reconstruct", real)
    (window,) = folder.plan().windows()[:1]
    assert [row.begun for row in folder.rows(window) if row.done] == ["cold", "warm"]
    assert run_left(folder, retry=True).done == 2
    whole = planned(tmp_path / "whole", files.scan, window=3)
    assert run_left(whole).done == 2
    for row, wanted in zip(folder.rows(window), whole.rows(window), strict=True):
        assert replace(row, seconds=0.0) == replace(wanted, seconds=0.0)


def test_a_good_state_is_not_thrown_away(done, files, tmp_path, monkeypatch):
    """Both starts are tried where the warm one seems worse, and the better one is kept: here the warm one, for the
    start by itself finds other matter."""
    real, other = series_time.reconstruct, moving(1, seeds=(4,)).as_static()
    monkeypatch.setattr(series_time, "_as_good", lambda left, reference: False)
    monkeypatch.setattr(
        series_time,
        "reconstruct",
        lambda scan, *args, folder, **how: real(
            other if folder.path.suffix == ".cold" else scan, *args, folder=folder, **how
        ),
    )
    folder = planned(tmp_path / "series", files.scan)
    run_task(folder, 0)
    rows = folder.rows(folder.plan().windows()[0])
    assert [row.begun for row in rows] == ["cold", "warm"]
    assert rows[1].decided.startswith("begun: warm (training frames: warm +")
    assert rows[1].decided in line_of(rows[1])
    assert same(arrays(folder, 0, 1), arrays(done, 0, 1))
    assert not folder.run(0, 1).with_name("t0001.cold").exists()


def test_other_matter_begins_anew(files, tmp_path):
    """The second time shows other cells: what warm leaves of it is compared, and the start by itself is kept. What was
    cut off after that goes on to the same row."""
    scan = tmp_path / "other.nxs"
    write_scan(scan, moving(2, seeds=(1, 4)))
    folder = planned(tmp_path / "series", scan)
    run_task(folder, 0)
    window = folder.plan().windows()[0]
    rows = folder.rows(window)
    assert [row.begun for row in rows] == ["cold", "anew"]
    assert rows[1].decided.startswith("begun: cold (training frames: warm ")
    assert RunFolder(folder.run(0, 1)).read_config()["method"]["kind"] == "gaussians"
    assert not folder.run(0, 1).with_name("t0001.cold").exists()
    for path in (folder.row(0, 1), folder.task(0) / "done.json"):
        path.unlink()
    run_task(folder, 0)
    assert replace(folder.rows(window)[1], seconds=0.0) == replace(rows[1], seconds=0.0)


def test_a_bad_time_is_tried_again_from_the_one_after_it(files, tmp_path, monkeypatch):
    """The first time finds other matter, which is not explained; on the way back it goes on from the second, which is.
    What is cut off before its row is written goes on to the same row, and nothing is tried twice."""
    real, other, tried = series_time.reconstruct, moving(1, seeds=(4,)).as_static(), list[str]()

    def misled(scan, *args, folder, **how):
        tried.append(folder.path.name)
        return real(other if folder.path.name == "t0000" and len(tried) < 3 else scan, *args, folder=folder, **how)

    def judged(row, done, evaluation):
        return replace(filled(row, done, evaluation), good=row.number > 0 or row.begun == "back")

    def cut_off(path, row):
        if row.begun == "back":
            raise KeyboardInterrupt
        write_row(path, row)

    filled = series_time.filled
    monkeypatch.setattr(series_time, "reconstruct", misled)
    monkeypatch.setattr(series_time, "filled", judged)
    folder = planned(tmp_path / "series", files.scan)
    window = folder.plan().windows()[0]
    with monkeypatch.context() as patch:
        patch.setattr(task, "write_row", cut_off)
        with pytest.raises(KeyboardInterrupt):
            run_task(folder, 0)
    before = folder.rows(window)
    assert [row.begun for row in before] == ["cold", "anew"]
    run_task(folder, 0)
    rows = folder.rows(window)
    assert [row.begun for row in rows] == ["back", "anew"]
    assert rows[0].decided.startswith("begun: back (training frames")
    assert rows[0].train["psnr"] > before[0].train["psnr"] + 3
    assert tried == ["t0000", "t0001", "t0001.cold", "t0000.back", "t0000"]
    assert sorted(path.name for path in folder.task(0).glob("t*") if path.is_dir()) == ["t0000", "t0001"]
    (folder.task(0) / "done.json").unlink()
    run_task(folder, 0)
    assert folder.rows(window) == rows


def test_a_series_says_which_times_are_not_explained(done):
    """On the terminal, in the table and on the page."""
    rows = [row for window in done.plan().windows() for row in done.rows(window)]
    assert verdict_of(rows) == ["the frames of 5 of 5 times are explained"]
    rows[3] = replace(rows[3], good=False, words="The frames are not explained: why.")
    assert verdict_of(rows) == [
        "the frames of 1 of 5 times are not explained, do not trust them: 3",
        "  time 3: The frames are not explained: why.",
    ]
    assert "NOT explained" in line_of(rows[3])
    assert ", explained, " in line_of(rows[2])


def test_a_scan_that_was_replaced_is_noticed(files, tmp_path):
    scan = tmp_path / "scan.nxs"
    shutil.copy(files.each / "scan9.nxs", scan)
    folder = planned(tmp_path / "series", scan)
    shutil.copy(files.each / "scan10.nxs", scan)
    state = run_task(folder, 0)
    assert state.state == "failed"
    assert "as it was when the series was planned, but its frames differ" in state.reason
    scan.unlink()
    assert "but it is gone" in run_task(folder, 0).reason


def test_warm_starts_need_a_method_that_takes_them():
    with pytest.raises(InputError, match="runs of auto, gaussians, surfaces and volume can be gone on from"):
        Settings(method=HolographicVoxels())


def test_a_task_of_a_series_loads_no_table_of_atoms():
    """Nor its database: δ and β are numbers in a plan."""
    code = "import sys\nimport holosplat.series.run\nprint(*(m for m in ('xraydb', 'sqlalchemy') if m in sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == []
