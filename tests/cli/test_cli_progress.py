"""Progress says how long the rest takes, once the part that is done tells it: a bar on a terminal, lines elsewhere."""

from __future__ import annotations

import contextlib
import io
import sys

import pytest

from helpers.cli import holosplat, refused
from holosplat.cli.progress import ProgressBar, logged


@pytest.fixture
def clock(monkeypatch) -> list[float]:
    """The time [s] that the bar sees."""
    now = [0.0]
    monkeypatch.setattr("tqdm.std.time", lambda: now[0])
    return now


def shown(clock: list[float], times: dict[float, float], capsys: pytest.CaptureFixture[str]) -> list[str]:
    """What stands on the screen at each of `times` [s], when so much is done."""
    sys.stderr.isatty = lambda: True
    lines = []
    with ProgressBar() as bar:
        for clock[0], fraction in times.items():
            bar.show("training", fraction, {"step": 5.0, "loss": 0.5, "seconds": 2.0})
            lines.append(capsys.readouterr().err.split("\r")[-1])
    return [*lines, capsys.readouterr().err.split("\r")[-1]]


def test_time_left_goes_by_what_is_done(clock, capsys):
    first, early, quarter, done, last = shown(clock, {0.0: 0.0, 20.0: 0.02, 100.0: 0.25, 400.0: 1.0}, capsys)

    assert "left" not in first + early + done + last
    assert "25%" in quarter
    assert "01:40, 05:00 left, loss 5.000e-01, 2.5 steps/s" in quarter
    assert "100%" in done


def test_what_is_resumed_does_not_begin_with_nothing(clock, capsys):
    first, early, later, _ = shown(clock, {0.0: 0.5, 10.0: 0.51, 60.0: 0.6}, capsys)

    assert "50%" in first
    assert "left" not in first + early
    assert "01:00, 04:00 left" in later


def lines_of(times: dict[float, float], stream: io.StringIO) -> list[str]:
    """What a stage says on `stream` that is done to so much at each of `times` [s]."""
    now = [0.0]
    with contextlib.redirect_stderr(stream), ProgressBar(lambda: now[0]) as bar:
        for now[0], fraction in times.items():
            bar.show("training", fraction, {"step": 5.0, "loss": 0.5, "seconds": 2.0})
    return stream.getvalue().splitlines()


def test_a_file_gets_a_line_now_and_then():
    """Of 1000 calls in 100 s: the stage, each twentieth, and the end; none of them is drawn over."""
    lines = lines_of({n / 10: n / 1000 for n in range(1001)}, io.StringIO())

    assert len(lines) == 21
    assert lines[0] == "training …"
    assert lines[5] == "training: 25%, 0:25, 1:15 left, loss 5.000e-01, 2.5 steps/s"
    assert lines[-1].startswith("training: 100%, 1:40")


def test_short_stages_have_one_line_and_slow_ones_one_a_minute():
    assert lines_of({n / 1000: n / 100 for n in range(101)}, io.StringIO()) == ["training …"]
    slow = lines_of({10.0 * n: n / 1e6 for n in range(31)}, io.StringIO())
    assert len(slow) == 1 + 5
    assert slow[1].startswith("training: 0%, 1:00")


class Terminal(io.StringIO):
    """A terminal."""

    def isatty(self) -> bool:
        return True


def test_a_log_has_lines_where_the_terminal_has_a_bar(tmp_path):
    terminal, log = Terminal(), tmp_path / "run.log"
    with contextlib.redirect_stderr(terminal), logged(["reconstruct", "a", f"--log={log}"]):
        lines_of({0.0: 0.0, 10.0: 0.5, 20.0: 1.0}, sys.stderr)
        print("done", file=sys.stderr)
    text = log.read_text().splitlines()

    assert "\r" in terminal.getvalue()
    assert "…" not in terminal.getvalue()
    assert [line[20:] for line in text[1:4]] == [
        "training …",
        "training: 50%, 0:10, 0:10 left, loss 5.000e-01, 2.5 steps/s",
        "training: 100%, 0:20, loss 5.000e-01, 2.5 steps/s",
    ]
    assert [line[20:] for line in text[4:]] == ["done", "ended with exit code 0"]


def test_a_log_holds_what_the_terminal_shows_and_goes_on(tmp_path):
    log = tmp_path / "run.log"
    said = holosplat("materials", "haemoglobin", "--log", log)
    refused(holosplat("check", tmp_path / "none", "--log", log), "none")
    lines = [line[20:] for line in log.read_text().splitlines()]

    assert lines[0].startswith("$ holosplat materials haemoglobin --log ")
    for line in (said.out + said.err).splitlines():
        assert line.rstrip() in lines
    assert lines.count("ended with exit code 0") == 1
    assert lines[-1] == "ended with exit code 2"
    assert lines[-2].startswith("holosplat: ")


def test_a_log_is_written_over_no_other_file(tmp_path):
    other = tmp_path / "scan.nxs"
    other.write_bytes(b"\x89HDF and so on")
    refused(
        holosplat("materials", "haemoglobin", "--log", other),
        "--log must be a new file, or a log",
        str(other),
    )
    refused(holosplat("materials", "haemoglobin", "--log", tmp_path / "no" / "log"), "existing folder")
    assert other.read_bytes() == b"\x89HDF and so on"
