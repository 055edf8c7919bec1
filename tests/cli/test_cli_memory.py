"""A process without memory for its libraries says so in one sentence, before they are loaded."""

from __future__ import annotations

import resource
import subprocess
import sys

import pytest

import holosplat.cli as start
from helpers.cli import PROGRAM
from holosplat import native
from holosplat.cli import entry
from holosplat.io.room import UNLIMITED


def limited(gigabytes: float, *arguments: str) -> subprocess.CompletedProcess[str]:
    """A command in a process whose address space is so large."""
    most = int(gigabytes * 1e9)
    command = [*PROGRAM, *arguments]
    return subprocess.run(
        command,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (most, most)),
    )


@pytest.mark.parametrize("gigabytes", [0.1, 0.3, 0.5, 0.7])
def test_too_little_address_space_is_one_sentence(gigabytes, tmp_path):
    done = limited(gigabytes, "reconstruct", str(tmp_path / "a.nxs"), "--out", str(tmp_path / "run"))
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert line.startswith("holosplat: the memory of this process must be at least 1.0 GB of address space and 0.4 GB")
    assert "but ulimit -v leaves 0." in line
    assert line.endswith("; raise the limit.")


def test_what_is_asked_for_does(tmp_path):
    """The libraries of a command fit into what the sentence says, or it is said of them. 20 MB are Python's own."""
    done = limited(start.MAPPED / 1e9 + 0.05, "check", str(tmp_path / "nowhere"))
    assert done.returncode == 2
    assert done.stderr.startswith("holosplat: ")
    assert len(done.stderr.splitlines()) == 1
    assert "ulimit" not in done.stderr


@pytest.mark.parametrize(
    ("left", "said"),
    [
        ((int(3e8), UNLIMITED), "but ulimit -v leaves 0.3 GB"),
        ((UNLIMITED, int(2e8)), "but its control group (a container, a cluster's job) leaves 0.2 GB"),
    ],
)
def test_limits_are_looked_at_while_libraries_are_to_be_loaded(left, said, monkeypatch, capsys):
    monkeypatch.setattr(start, "left_by_limits", lambda: left)
    monkeypatch.setattr(sys, "argv", ["holosplat", "--version"])
    start.main()  # they are there already
    assert capsys.readouterr().err == ""
    monkeypatch.delitem(sys.modules, "torch")
    with pytest.raises(SystemExit) as end:
        start.main()
    assert end.value.code == 2
    assert said in capsys.readouterr().err


def fails_with(error: BaseException, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail() -> None:
        raise error

    monkeypatch.setattr(entry, "main", fail)


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (ImportError("libtorch_cpu.so: failed to map segment from shared object"), "(libtorch_cpu.so: failed to map"),
        (ImportError("a.so: cannot allocate memory in static TLS block"), "a library finds no room (a.so: cannot"),
        (MemoryError(), "its libraries find no room"),
        (SystemError("<built-in function compile> returned NULL without setting an exception"), "Python finds no room"),
    ],
)
def test_a_library_that_finds_no_room_is_one_sentence(error, said, monkeypatch, capsys):
    fails_with(error, monkeypatch)
    with pytest.raises(SystemExit) as end:
        start.main()
    assert end.value.code == 2
    assert said in capsys.readouterr().err


def test_a_library_that_is_missing_is_not_called_a_lack_of_memory(monkeypatch):
    fails_with(ImportError("No module named torch"), monkeypatch)
    with pytest.raises(ImportError, match="No module named torch"):
        start.main()


def test_kernels_that_find_no_room_are_not_called_missing(tmp_path, monkeypatch):
    def full(name: str) -> None:
        raise OSError(f"{name}: failed to map segment from shared object")

    monkeypatch.setattr(native.ctypes, "CDLL", full)
    with pytest.raises(MemoryError, match=r"the compiled kernels find no room: .*failed to map segment"):
        native._open.__wrapped__(tmp_path, "none")
