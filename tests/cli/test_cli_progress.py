"""The progress bar says how long the rest takes, once the part that is done tells it."""

from __future__ import annotations

import pytest

from holosplat.cli.progress import ProgressBar


@pytest.fixture
def clock(monkeypatch) -> list[float]:
    """The time [s] that the bar sees."""
    now = [0.0]
    monkeypatch.setattr("tqdm.std.time", lambda: now[0])
    return now


def shown(clock: list[float], times: dict[float, float], capsys: pytest.CaptureFixture[str]) -> list[str]:
    """What stands on the screen at each of `times` [s], when so much is done."""
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
