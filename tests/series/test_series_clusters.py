"""The same tasks by several processes, by Slurm, and on a Dask cluster."""

from __future__ import annotations

import json
import os
import shutil
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from helpers.cli import holosplat, refused, worked
from helpers.series import planned
from holosplat.checks import InputError, MissingError
from holosplat.io.atomic import write_json
from holosplat.series import run as running
from holosplat.series.folder import FAILED, SeriesFolder
from holosplat.series.plan import Slurm
from holosplat.series.run import Counts, ranges_of, run_on_dask, run_processes, script_of


@pytest.fixture
def fresh(files, tmp_path) -> SeriesFolder:
    """A series of which nothing is done."""
    return planned(tmp_path / "a series", files.scan)


def fake_sbatch(folder: Path, code: int, says: str) -> Path:
    """An sbatch that notes its arguments, says something and ends."""
    program = folder / "sbatch"
    program.write_text(
        f'#!/bin/sh\nprintf "%s\\n" "$@" > "{folder}/asked"\necho "{says}" {">&2" if code else ""}\nexit {code}\n'
    )
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    return program


def test_a_script_asks_for_what_is_left(fresh, done):
    shutil.copytree(done.task(1), fresh.task(1))
    options = [
        "--partition",
        "upex",
        "--time",
        "02:00:00",
        "--memory",
        "8G",
        "--cpus",
        3,
        "--limit",
        30,
        "--gres",
        "gpu:1",
    ]
    out = worked(holosplat("series", "run", fresh.path, "--slurm", *options))
    assert "2 tasks: 0,2" in out.err
    lines = fresh.script.read_text().splitlines()
    assert lines[0] == "#!/bin/bash"
    asked = {line.removeprefix("#SBATCH ") for line in lines if line.startswith("#SBATCH")}
    assert {"--array=0,2%30", "--partition=upex", "--time=02:00:00", "--mem=8G", "--cpus-per-task=3"} < asked
    assert f'--output="{fresh.path.resolve()}/logs/%A_%a.out"' in asked
    subprocess.run(["bash", "-n", fresh.script], check=True)
    assert os.access(fresh.script, os.X_OK)
    assert fresh.logs.is_dir()


def test_the_script_runs_a_task(fresh, tmp_path):
    """As Slurm would: with the number of the task in the environment; Python itself is a stand-in."""
    text = script_of(fresh, [1], Slurm()).replace(sys.executable, "printf '%s\\n'", 1)
    script = tmp_path / "script.sh"
    script.write_text(text.replace("exec printf", "printf"))
    environment = os.environ | {"SLURM_ARRAY_TASK_ID": "1", "SLURM_CPUS_PER_TASK": "3"}
    said = subprocess.run(["bash", script], env=environment, capture_output=True, text=True, check=True).stdout
    assert said.splitlines()[-4:] == ["series", "run", str(fresh.path.resolve()), "1"]


def test_a_job_does_a_block_of_tasks(files, tmp_path):
    """Jobs are numbered by their first tasks; what is done is passed over, and what failed unless that is asked for."""
    series = planned(tmp_path / "blocks", files.scan)
    text = script_of(series, [1, 2, 5, 9, 11], Slurm(block=4))
    assert "#SBATCH --array=0,4,8\n" in text
    assert text.splitlines()[-1].endswith('"$SLURM_ARRAY_TASK_ID" --block 4')
    assert script_of(series, [1], Slurm(block=4), retry=True).splitlines()[-1].endswith("--block 4 --retry")
    subprocess.run(["bash", "-n"], input=text, text=True, check=True)


def test_a_plan_does_not_allow_its_scans_values_of_other_files(fresh, monkeypatch):
    """Whoever runs it does, and then its processes and its script, too."""
    plan = json.loads(fresh.file.read_text())
    write_json(fresh.file, plan | {"reading": plan["reading"] | {"allow_external": True}})
    refused(holosplat("series", "run", fresh.path, "--jobs", 1), "values of other files", "add --allow-external")
    monkeypatch.setattr(
        running, "PROGRAM", ("-c", "import pathlib, sys; pathlib.Path(sys.argv[3], sys.argv[4]).touch()")
    )
    assert holosplat("series", "run", fresh.path, "--jobs", 1, "--allow-external").code == 4
    assert (fresh.path / "--allow-external").exists()
    assert script_of(fresh, [1], Slurm()).splitlines()[-1].endswith('"$SLURM_ARRAY_TASK_ID" --allow-external')


def test_a_block_is_what_is_left_from_a_task_on(fresh, done):
    shutil.copytree(done.task(1), fresh.task(1))
    fresh.task(2).mkdir()
    write_json(fresh.task(2) / FAILED, {"reason": "tried"})
    said = holosplat("series", "run", fresh.path, 1, "--block", 9)
    assert said.code == 4
    assert "1 done, 0 running, 1 failed, 0 left" in said.err
    worked(holosplat("series", "run", fresh.path, 1, "--block", 9, "--retry"))
    assert [fresh.state(window).state for window in fresh.plan().windows()] == ["left", "done", "done"]
    refused(holosplat("series", "run", fresh.path, 3, "--block", 2), "counted from 0 to 2")
    refused(holosplat("series", "run", fresh.path, "--block", 2), "--block goes with a task's number or --slurm")


def test_a_script_is_submitted_when_it_is_asked_for(fresh, tmp_path, monkeypatch):
    fake_sbatch(tmp_path, 0, "4711;cluster")
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    worked(holosplat("series", "run", fresh.path, "--slurm"))
    assert not (tmp_path / "asked").exists()
    assert worked(holosplat("series", "run", fresh.path, "--submit")).out == "4711\n"
    assert (tmp_path / "asked").read_text().splitlines() == ["--parsable", str(fresh.script.resolve())]
    fake_sbatch(tmp_path, 1, "sbatch: error: invalid partition")
    refused(holosplat("series", "run", fresh.path, "--submit"), "invalid partition")
    monkeypatch.setenv("PATH", "")
    refused(holosplat("series", "run", fresh.path, "--submit"), "there is none here")


def test_words_that_a_shell_would_read_are_refused(fresh, done):
    for name in ("partition", "time", "memory", "account", "gres"):
        with pytest.raises(InputError, match=f"{name} must be a word"):
            Slurm(**{name: "a;rm -rf ~"})
    refused(holosplat("series", "run", done.path, "--slurm"), "no task that is left")


def test_lists_of_numbers():
    assert ranges_of([0, 1, 2, 5, 7, 8]) == "0-2,5,7-8"


def test_processes_share_the_tasks(fresh, done, monkeypatch):
    """Each has its part of the cores; what a stand-in does in them is counted."""
    write = "pathlib.Path(sys.argv[3], f'asked{os.getpid()}').write_text(os.environ['OMP_NUM_THREADS'])"
    stand_in = f"import os, pathlib, sys; {write}"
    monkeypatch.setattr(running, "PROGRAM", ("-c", stand_in))
    monkeypatch.setattr(running, "cores", lambda: 5)
    assert run_processes(fresh, 2) == Counts(0, 0, 0, 3)
    assert [path.read_text() for path in fresh.path.glob("asked*")] == ["2", "2"]
    with pytest.raises(InputError, match="--jobs must be at least 1"):
        run_processes(fresh, -1)


def test_a_cluster_of_dask_does_the_tasks(fresh, done):
    """A real one, within this process; what is done already is not asked for."""
    distributed = pytest.importorskip("distributed")
    shutil.copytree(done.task(1), fresh.task(1))
    how = {"processes": False, "n_workers": 1, "threads_per_worker": 1, "dashboard_address": ":0"}
    told = []
    with distributed.LocalCluster(**how) as cluster:
        counts = run_on_dask(fresh, cluster.scheduler_address, on_task=lambda state: told.append(state.number))
    assert counts == Counts(3, 0, 0, 0)
    assert sorted(told) == [0, 2]


def test_without_dask_or_without_a_scheduler(fresh, monkeypatch):
    if shutil.which("true") and "distributed" in sys.modules:
        monkeypatch.setattr("holosplat.series.run.CONNECT_SECONDS", 0.2)
        with pytest.raises(InputError, match="must be the address of a Dask scheduler"):
            run_on_dask(fresh, "tcp://127.0.0.1:9")
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(MissingError, match=r"holosplat\[dask\]"):
        run_on_dask(fresh, "tcp://127.0.0.1:9")
