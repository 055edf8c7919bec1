"""Commands say what they take before they begin, and refuse what does not fit, in one sentence that says what would."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from helpers.cli import Workshop, holosplat, known, refused
from helpers.moving_ellipsoids import scan
from holosplat.io.nxtomo import write_scan
from holosplat.planning import needs

KNOWN = ("--material", "haemoglobin")


@pytest.fixture(scope="module")
def series(tmp_path_factory) -> Path:
    """Frames of several times."""
    path = tmp_path_factory.mktemp("series") / "scan.nxs"
    write_scan(path, scan())
    return path


COMMANDS: dict[str, Callable[[Workshop, Path], list[object]]] = {
    "track": lambda shop, series: ["track", series, *KNOWN],
    "align": lambda shop, series: ["align", shop.scan, *KNOWN],
    "grow": lambda shop, series: ["grow", "--cells", 2, "--snapshots", 3],
    "surface": lambda shop, series: ["surface", shop.run],
    "dataset": lambda shop, series: ["dataset", "--count", 2, "--rows", 24, "--columns", 24],
    "bench": lambda shop, series: ["bench", "run", "--cases", "main12", "cells8", "--methods", "paganin-tv"],
    "pinn": lambda shop, series: ["reconstruct", series, *KNOWN, "--method", "pinn", "--time-frame", "all"],
    "each": lambda shop, series: ["reconstruct", series, *known(shop), "--time-frame", "each"],
    "all": lambda shop, series: ["reconstruct", series, *KNOWN, "--time-frame", "all", "--matter", "continuous"],
}


@pytest.mark.parametrize("name", list(COMMANDS))
def test_what_memory_cannot_hold_is_refused_before_anything_is_made(shop, series, tmp_path, monkeypatch, name):
    monkeypatch.setattr(needs, "free_memory", lambda: -4e8)
    out = tmp_path / "out"
    refused(holosplat(*COMMANDS[name](shop, series), "--out", out), "takes about", "of memory and", "free;")
    assert not out.exists()


@pytest.mark.parametrize("name", list(COMMANDS))
def test_what_the_disk_cannot_hold_is_refused_too(shop, series, tmp_path, monkeypatch, name):
    monkeypatch.setattr(needs, "free_disk", lambda path: 1000)
    out = tmp_path / "out"
    refused(holosplat(*COMMANDS[name](shop, series), "--out", out), "takes about", "of disk are free;")
    assert not out.exists()


def test_a_volume_that_does_not_fit_is_refused_with_what_would(shop, tmp_path, monkeypatch):
    monkeypatch.setattr(needs, "free_memory", lambda: 3e8)
    command = ["export", shop.run, "--shape", 300, 290, 310, "--volume"]
    refused(holosplat(*command, tmp_path / "a.ome.tif"), "free; an HDF5 file takes")
    monkeypatch.setattr(needs, "free_memory", lambda: 10e9)
    monkeypatch.setattr(needs, "free_disk", lambda path: 1e8)
    refused(
        holosplat(*command, tmp_path / "a.h5"), "free; an HDF5 file with --shape 150 145 155 of larger voxels takes"
    )
    assert list(tmp_path.iterdir()) == []


def test_fewer_cases_fit(tmp_path, monkeypatch):
    """The larger case is left out of what is proposed."""
    command = ["bench", "run", "--cases", "main12", "thesis16", "--methods", "gaussians", "--out", tmp_path / "out"]
    monkeypatch.setattr(needs, "free_memory", lambda: 7e8)
    refused(holosplat(*command), "free; --cases thesis16 takes")


def test_a_smaller_mesh_and_larger_pixels_are_proposed(shop, tmp_path, monkeypatch):
    monkeypatch.setattr(needs, "free_memory", lambda: 1e8)
    refused(holosplat("grow", "--cells", 2, "--frequency", 20, "--out", tmp_path / "out"), "free; --frequency")
