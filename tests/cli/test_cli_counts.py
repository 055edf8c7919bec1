"""Counts that no experiment has are refused before anything of that size is made."""

from __future__ import annotations

import time

import pytest

from helpers.cli import Outcome, holosplat, refused, simulate

LARGE = (10**9, 30_000_000, 1_000_001)


def at_once(call, *words: str) -> None:
    """Refused within seconds, by a sentence with these words."""
    began = time.perf_counter()
    done: Outcome = call()
    refused(done, *words)
    assert time.perf_counter() - began < 10


@pytest.mark.parametrize("count", LARGE)
@pytest.mark.parametrize("flag", ["--views", "--frames", "--pulses"])
def test_frames_of_a_simulation(shop, tmp_path, flag, count):
    out = tmp_path / "out.nxs"
    views = () if flag == "--views" else ("--views", 4)
    at_once(
        lambda: simulate(shop, *views, flag, count, "--out", out),
        f"{flag} must be at most 1",
        "but it is",
    )
    assert not out.exists()


@pytest.mark.parametrize("count", LARGE)
@pytest.mark.parametrize("flag", ["--flats", "--darks"])
def test_frames_of_a_recording(shop, tmp_path, flag, count):
    out = tmp_path / "raw.nxs"
    at_once(lambda: holosplat("record", shop.scan, "--out", out, flag, count), f"{flag} must be at most 100000, but")
    assert not out.exists()


def test_frames_of_all_times_together(tmp_path):
    """Each of the two numbers is one that an experiment may have."""
    out = tmp_path / "out.nxs"
    specimen = ["simulate", "--specimen", "stirred-blob", "--pixel-size", "3e-6", "--detector", 8, 9, "--out", out]
    many = ["--views", 2000, "--frames", 1000, "--frame-rate", 1e6]
    at_once(
        lambda: holosplat(*specimen, *many),
        "views and times must make at most 1000000 frames, but they make 2000000; take fewer of --views or --frames.",
    )
    assert not out.exists()


def test_scenes_and_processes(tmp_path):
    out = tmp_path / "out"
    at_once(lambda: holosplat("dataset", "--count", 10**9, "--out", out), "--count must be at most 1000000, but")
    at_once(lambda: holosplat("dataset", "--jobs", 10**9, "--out", out), "--jobs must be at most 1000")
    at_once(lambda: holosplat("series", "run", out, "--jobs", 10**9), "--jobs must be at most 1000")
    assert not out.exists()
