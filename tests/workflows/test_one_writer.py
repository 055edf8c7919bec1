"""One writer of a folder, and files that belong together."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import shutil
import socket
import subprocess
import sys

import numpy as np
import pytest

from holosplat.checks import InputError
from holosplat.io import lock
from holosplat.io.atomic import atomic_folder, atomic_path, is_taken
from holosplat.io.hdf5 import new_hdf5, put
from holosplat.io.lock import LOCK, host, sole_writer, temporary_name
from holosplat.workflows.provenance import MANIFEST, faults
from holosplat.workflows.run_folder import RunFolder, check, claimed


def lock_of(process: int, machine: str = "", began: str = "1") -> str:
    return json.dumps({"host": machine or socket.gethostname(), "process": process, "began": began, "since": "today"})


@pytest.fixture
def gone():
    """The number of a process that is no more."""
    with subprocess.Popen([sys.executable, "-c", ""]) as process:
        process.wait()
    return process.pid


def test_another_process_may_not_write_to_it(tmp_path):
    """A live one of this machine, by its number and beginning; nothing is touched."""
    with sole_writer(tmp_path / "run"):
        text = (tmp_path / "run" / LOCK).read_text()
        done = ended_elsewhere(tmp_path / "run")
        assert done.returncode == 1
        assert f"must have one writer, but process {os.getpid()} on {socket.gethostname()} writes to it" in done.stderr
        assert (tmp_path / "run" / LOCK).read_text() == text
    assert not (tmp_path / "run").exists()


def ended_elsewhere(folder, *before) -> subprocess.CompletedProcess:
    """A process that writes to a folder, started by a command `before`."""
    code = (
        "from pathlib import Path; from holosplat.io.lock import sole_writer; import sys\n"
        "with sole_writer(Path(sys.argv[1])): pass"
    )
    command = [*before, sys.executable, "-c", code, folder]
    return subprocess.run(command, capture_output=True, text=True, check=False)


CONTAINER = ("unshare", "--pid", "--fork")
"""What gives a process another namespace of processes, as containers do, with the same name of the machine."""


@pytest.mark.skipif(
    shutil.which("unshare") is None or subprocess.run([*CONTAINER, "true"], check=False).returncode != 0,
    reason="this user may not make a namespace of processes",
)
@pytest.mark.parametrize("locks", [True, False])
def test_a_process_of_another_container_may_not_write_to_it(tmp_path, monkeypatch, locks):
    """Its number is that of another process here, or of none: by the kernel's lock, and where there is none, too."""
    if not locks:
        monkeypatch.setattr(fcntl, "flock", without_locks)
    with sole_writer(tmp_path / "run"):
        done = ended_elsewhere(tmp_path / "run", *CONTAINER)
        assert done.returncode == 1
        assert "must have one writer" in done.stderr
    assert ended_elsewhere(tmp_path / "run", *CONTAINER).returncode == 0


def without_locks(*_: object) -> None:
    raise OSError(errno.ENOLCK, "No locks available")


def test_a_file_system_without_locks_is_written_to(tmp_path, monkeypatch, gone):
    monkeypatch.setattr(fcntl, "flock", without_locks)
    for text in ("", lock_of(gone)):
        if text:
            (tmp_path / LOCK).write_text(text)
        with sole_writer(tmp_path):
            assert json.loads((tmp_path / LOCK).read_text())["locked"] is False
            done = ended_elsewhere(tmp_path)
            assert "must have one writer" in done.stderr
        tmp_path.mkdir(exist_ok=True)


def test_a_lock_that_the_kernel_let_go_is_taken_over(tmp_path, gone):
    """Whatever its number means here: of a process that is alive, of another container, or before a new start."""
    for change in ({"process": os.getppid()}, {"namespace": "pid:[1]"}, {"boot": "before"}, {"host": "renamed"}):
        (tmp_path / LOCK).write_text(json.dumps(lock._self() | {"process": gone, "locked": True} | change))
        with sole_writer(tmp_path):
            assert json.loads((tmp_path / LOCK).read_text())["process"] == os.getpid()
        tmp_path.mkdir(exist_ok=True)


def test_what_a_forked_child_holds_does_not_outlive_its_parent(tmp_path):
    with sole_writer(tmp_path):
        child = os.fork()
        if child == 0:
            os._exit(len(lock._held))
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
        assert "must have one writer" in ended_elsewhere(tmp_path).stderr


def test_a_full_disk_leaves_no_draft_of_a_lock(tmp_path, monkeypatch):
    def full() -> dict:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(lock, "_self", full)
    with pytest.raises(InputError, match="No space left"), sole_writer(tmp_path):
        raise AssertionError("it must not begin")
    assert os.listdir(tmp_path) == []


def test_a_process_writes_to_its_own_folder_within_itself(tmp_path):
    with sole_writer(tmp_path / "run"):
        with sole_writer(tmp_path / "run"):
            (tmp_path / "run" / "a").write_text("a")
        assert (tmp_path / "run" / LOCK).exists()
    assert os.listdir(tmp_path / "run") == ["a"]


def test_a_lock_of_a_process_that_is_no_more_is_taken_over(tmp_path, gone):
    """So is that of an older process of the same number, this one's too; what it left half-written goes."""
    for text in (lock_of(gone), lock_of(os.getpid()), lock_of(os.getppid())):
        (tmp_path / LOCK).write_text(text)
        left = tmp_path / f".rows~{host()}-{gone:x}-0123abcd.csv"
        left.write_text("half")
        with sole_writer(tmp_path):
            assert json.loads((tmp_path / LOCK).read_text())["process"] == os.getpid()
            assert not left.exists()
        tmp_path.mkdir(exist_ok=True)


@pytest.mark.parametrize("text", [lock_of(1, "elsewhere"), "", "[]", '{"process": "x"}'])
def test_a_lock_that_cannot_be_judged_is_left(tmp_path, text):
    (tmp_path / LOCK).write_text(text)
    with pytest.raises(InputError, match=r"remove .*\.lock if there is no such process"), sole_writer(tmp_path):
        raise AssertionError("it must not begin")
    assert (tmp_path / LOCK).read_text() == text


def test_a_folder_of_locks_and_leftovers_is_free(tmp_path, gone):
    """A run that was killed at its start can be begun anew, without --resume."""
    run = tmp_path / "run"
    run.mkdir()
    (run / LOCK).write_text(lock_of(gone))
    (run / f".config~{host()}-{gone:x}-0123abcd.json").write_text("{")
    assert not is_taken(run)
    RunFolder(run).require_new()
    with atomic_folder(run) as folder:
        (folder / "a").write_text("a")
    assert os.listdir(run) == ["a"]
    assert is_taken(run)


def test_what_a_killed_process_left_of_a_file_goes_with_the_next_one(tmp_path, gone):
    """Not what a living one is writing, nor one of another machine, nor a file of the user's."""
    dead = tmp_path / f".scan~{host()}-{gone:x}-0123abcd.nxs"
    kept = [temporary_name(tmp_path / "scan.nxs"), tmp_path / ".scan~deadbeef-1-0123abcd.nxs", tmp_path / ".scan~.nxs"]
    for path in (dead, *kept):
        path.write_text("half")
    with atomic_path(tmp_path / "scan.nxs") as temporary:
        temporary.write_text("whole")
    assert not dead.exists()
    assert all(path.exists() for path in kept)


def begun(path) -> RunFolder:
    folder = RunFolder(path)
    with claimed(folder):
        folder.begin({"seed": 1})
        folder.start_metrics(["step", "loss"])
        folder.append_metrics([{"step": 1.0, "loss": 0.5}, {"step": 2.0, "loss": 0.25}])
        folder.write_summary({"finished": True})
        folder.save_checkpoint({"step": 2})
    return folder


def test_checkpoints_and_summaries_of_another_run_are_refused(tmp_path):
    one, other = begun(tmp_path / "one"), begun(tmp_path / "other")
    assert one.load_checkpoint() == {"step": 2}
    one.checkpoint.write_bytes(other.checkpoint.read_bytes())
    with pytest.raises(InputError, match="but it is of another one"):
        one.load_checkpoint()
    one.summary.write_bytes(other.summary.read_bytes())
    with pytest.raises(InputError, match="but it is of another one"):
        one.read_summary()


def test_the_checkpoint_before_serves_where_the_last_one_is_damaged(tmp_path):
    folder = begun(tmp_path / "run")
    folder.save_checkpoint({"step": 3, "values": list(range(400))})
    content = bytearray(folder.checkpoint.read_bytes())
    content[len(content) // 2] ^= 1  # within the values: torch itself would not notice
    folder.checkpoint.write_bytes(content)
    assert folder.load_checkpoint() == {"step": 2}
    folder.checkpoint.unlink()
    assert folder.load_checkpoint() == {"step": 2}
    folder.earlier_checkpoint.write_bytes(b"")
    with pytest.raises(InputError, match="damaged; start anew"):
        folder.load_checkpoint()


@pytest.mark.parametrize("torn", ["3,0.1", "3\n", "3,0.\0\n", "3,x\n", "\0\0\0\n", "3,1,2\n"])
def test_a_torn_row_of_metrics_is_left_out(tmp_path, torn):
    folder = begun(tmp_path / "run")
    with folder.metrics.open("a") as file:
        file.write(torn)
    assert folder.history()["step"].tolist() == [1, 2]
    folder.start_metrics(["step", "loss"], keep_until=1)
    assert folder.history()["loss"].tolist() == [0.5]


def test_a_manifest_says_what_was_written(tmp_path):
    folder = begun(tmp_path / "run")
    name = folder.name()
    assert faults(folder.path, name) == []
    with folder.summary.open("a") as file:
        file.write(" ")
    (folder.path / "stray.txt").write_text("")
    folder.checkpoint.unlink()
    assert faults(folder.path, name) == [
        f"{folder.checkpoint} is missing",
        f"{folder.path / MANIFEST} does not know of {folder.path / 'stray.txt'}",
        f"{folder.summary} is not what was written",
    ]
    assert faults(folder.path, "another")[0].endswith("is of another run than config.json")


def test_check_says_what_is_not_as_it_was_written(tmp_path):
    folder = begun(tmp_path / "run")
    with claimed(folder), new_hdf5(folder.object) as file:
        put(file, "values", np.arange(1000.0).reshape(20, 50))
    assert check(folder.path) == check(folder.object) == (1, [])
    content = bytearray(folder.object.read_bytes())
    content[content.index(np.arange(300.0, 310.0).tobytes())] ^= 1
    folder.object.write_bytes(content)
    count, wrong = check(folder.path)
    assert count == 1
    assert wrong[0] == f"{folder.object} is not what was written"
    assert "filter returned failure" in wrong[1]
    for path, said in ((tmp_path / "none", "there is nothing"), (tmp_path / "empty", "holds none")):
        (tmp_path / "empty").mkdir(exist_ok=True)
        with pytest.raises(InputError, match=said):
            check(path)
