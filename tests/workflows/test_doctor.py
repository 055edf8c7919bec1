"""`holosplat doctor`: a good installation passes, and each fault is said with what to do, with exit code 1."""

from __future__ import annotations

import numpy as np
import pytest

from helpers.cli import holosplat
from holosplat.workflows import doctor


@pytest.fixture
def quick(monkeypatch) -> None:
    """Without the small run, and with little written."""
    monkeypatch.setattr(doctor, "small_run", lambda: ("not made here", ""))
    monkeypatch.setattr(doctor, "WRITTEN", 1 << 20)
    monkeypatch.setattr(doctor, "SLOW_DISK", 0.0)
    monkeypatch.setattr(doctor, "LEAST_MEMORY", 0.0)
    monkeypatch.setattr(doctor, "LEAST_DISK", 0.0)
    monkeypatch.setattr(doctor, "_threads", lambda: doctor.Check("threads", "1 on 1 cores"))


@pytest.mark.usefixtures("quick")
def test_a_good_installation_passes():
    done = holosplat("doctor")
    assert done.code == 0, done.out
    names = ("holosplat", "Python", "torch", "kernels cpu", "threads", "memory", "disk cache", "extras", "small run")
    assert all(any(line.startswith(name) for line in done.out.splitlines()) for name in names)
    assert "differ from plain torch by" in done.out
    assert done.out.endswith("all is well\n")


@pytest.mark.parametrize(
    ("version", "here", "said"), [("13.0", False, True), ("13.0", True, False), (None, False, False)]
)
def test_the_cpu_build_of_torch_is_named_where_there_is_no_gpu(monkeypatch, version, here, said):
    monkeypatch.setattr(doctor.torch.version, "cuda", version)
    monkeypatch.setattr(doctor.torch.cuda, "is_available", lambda: here)
    found = next(check.found for check in doctor.checks() if check.name == "torch")
    assert ("CPU build does as much in less room" in found) == said


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize(
    ("name", "value", "remedy"),
    [
        ("missing", lambda backend: "no kernels" if backend == "cpu" else "no GPU", "install a C++ compiler"),
        ("kernel_difference", lambda backend: 0.1, "the kernels are wrong"),
        ("LEAST_DISK", 1e18, "make room in"),
        ("LEAST_MEMORY", 1e18, "take a larger machine"),
        ("SLOW_DISK", 1e18, "is slow"),
    ],
)
def test_each_fault_is_said_with_what_to_do(monkeypatch, name, value, remedy):
    monkeypatch.setattr(doctor, name, value)
    done = holosplat("doctor")
    assert done.code == 1
    assert remedy in done.out
    assert "what to do stands below" in done.out


def test_a_small_run_finds_two_cells_and_its_error_is_held_against_a_limit(monkeypatch):
    found, remedy = doctor.small_run()
    error = float(found.rsplit(" ", 2)[1])
    assert 0 < error < 30
    assert remedy == ""
    monkeypatch.setattr(doctor, "LARGEST_ERROR", 0.01)
    assert "the result is wrong" in doctor.small_run()[1]


def test_kernels_that_compute_something_else_are_noticed(monkeypatch):
    """The plain twin is what they are held against."""
    assert doctor.kernel_difference("cpu") < 1e-4
    real = doctor._frames_and_gradients
    monkeypatch.setattr(
        doctor,
        "_frames_and_gradients",
        lambda name: [each * (1.01 if name == "cpu" else 1) for each in real(name)],
    )
    assert doctor.kernel_difference("cpu") == pytest.approx(0.01, rel=0.05)


def test_a_disk_that_cannot_be_written_is_a_fault(monkeypatch, tmp_path):
    def full(**options: object) -> object:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(doctor.tempfile, "TemporaryFile", full)
    check = doctor._tried("disk", lambda: doctor._disk(tmp_path))
    assert "No space left" in check.remedy
    assert np.isfinite(doctor.free_disk(tmp_path))
