"""Bad scans and bad requests: what the command line says and leaves behind."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import replace

import h5py
import numpy as np
import pytest

from helpers.cli import (
    BEAM,
    DETECTOR,
    MATTER,
    copied,
    everything_in,
    holosplat,
    in_a_shell,
    known,
    put,
    refused,
    simulate,
    truncated,
)
from holosplat.io.nxtomo import read_scan, write_scan


def five_angles(file: h5py.File) -> None:
    for name in ("entry/sample/view_rotation", "entry/sample/rotation_angle", "entry/data/rotation_angle"):
        del file[name]
    file["entry/sample/rotation_angle"] = np.arange(5.0)
    file["entry/sample/rotation_angle"].attrs["units"] = "deg"


def huge_pixels(file: h5py.File) -> None:
    for axis in "xy":
        put(f"{DETECTOR}/{axis}_pixel_size", 3.2)(file)


def nan_image(file: h5py.File) -> None:
    file[f"{DETECTOR}/data"][2] = np.nan


def nan_image_held_out(file: h5py.File) -> None:
    file[f"{DETECTOR}/data"][3] = np.nan


def no_images(file: h5py.File) -> None:
    """Neither the detector's images nor the link to them, which would do."""
    del file[f"{DETECTOR}/data"], file["entry/data/data"]


BAD_SCANS: dict[str, tuple[Callable[[h5py.File], object], list[str]]] = {
    "missing energy": (
        lambda f: f.__delitem__("entry/instrument/beam/incident_energy"),
        ["incident_energy", "missing"],
    ),
    "negative energy": (put("entry/instrument/beam/incident_energy", -20.0), ["incident_energy", "positive", "-20"]),
    "energy in eV": (put("entry/instrument/beam/incident_energy", 2e4), ["incident_energy", "20000", "unit"]),
    "wrong number of angles": (five_angles, ["rotation_angle", "8", "5"]),
    "unknown unit": (put(f"{DETECTOR}/distance", 0.1, "furlong"), ["detector/distance", "furlong", "mm"]),
    "negative distance": (put(f"{DETECTOR}/distance", -0.1), ["detector/distance", "positive", "-0.1"]),
    "NaN images": (nan_image, ["detector/data", "finite", "100% of frame 2"]),
    "a held-out image of NaN": (nan_image_held_out, ["detector/data", "finite", "100% of frame 3"]),
    "no training frame": (put("entry/split", np.ones(8, int)), ["training frame", "/entry/split"]),
    "a pixel of 3.2 m": (huge_pixels, ["pixel_size", "3.2", "unit"]),
    "no images": (no_images, ["data", "missing"]),
    "nothing to see": (put(f"{DETECTOR}/data", np.ones((8, 24, 28))), ["no matter"]),
}


@pytest.mark.parametrize("fault", BAD_SCANS)
def test_bad_scans_are_refused_and_leave_no_run(shop, tmp_path, fault):
    change, words = BAD_SCANS[fault]
    scan = copied(shop.scan, tmp_path, change)
    before = everything_in(tmp_path)
    refused(holosplat("reconstruct", scan, "--out", tmp_path / "run", *known(shop)), *words)
    assert everything_in(tmp_path) == before


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("missing.nxs", None, ["missing.nxs", "no such file"]),
        ("empty.nxs", b"", ["empty.nxs", "HDF5"]),
        ("text.nxs", b"hello", ["text.nxs", "HDF5"]),
        ("scan.nxs", "half", ["scan.nxs", "truncated"]),
        (".", None, ["folder"]),
    ],
)
def test_files_that_are_no_scans_are_refused(shop, tmp_path, name, content, words):
    if content == "half":
        truncated(shop.scan, tmp_path)
    elif content is not None:
        (tmp_path / name).write_bytes(content)
    before = everything_in(tmp_path)
    for command in (
        ["reconstruct", tmp_path / name, "--out", tmp_path / "new", *known(shop)],
        ["render", shop.run, "--scan", tmp_path / name, "--out", tmp_path / "new.nxs"],
        ["evaluate", shop.run, "--scan", tmp_path / name],
    ):
        refused(holosplat(*command), *words)
        assert everything_in(tmp_path) == before


def test_bad_input_in_a_shell_gives_one_line_and_no_traceback(shop, tmp_path):
    """As people meet it: the process ends with 2 and stderr is that line alone. Two more, within this process."""
    scan = truncated(shop.scan, tmp_path)
    views = ["simulate", shop.cells[0], *MATTER, *BEAM, "--views", 0, "--out", tmp_path / "o.nxs"]
    for outcome, word in (
        (in_a_shell("evaluate", "nowhere", cwd=tmp_path), "nowhere"),
        (holosplat("reconstruct", scan, "--out", tmp_path / "run"), "truncated"),
        (holosplat(*views), "views"),
    ):
        refused(outcome, word)
        assert len(outcome.err.removeprefix("loading libraries …\n").strip().splitlines()) == 1
        assert outcome.out == ""
    assert list(tmp_path.iterdir()) == [scan]


BAD_REQUESTS: dict[str, tuple[list[str], list[str]]] = {
    "unknown preset": (["--material", "haemoglobin", "--preset", "quick"], ["preset", "default", "fast", "quick"]),
    "bad formula": (["--material", "H2Q", "--density", "1"], ["material", "H2Q"]),
    "formula without density": (["--material", "H2O"], ["H2O", "density"]),
    "negative density": (["--material", "H2O", "--density", "-1"], ["density", "positive", "-1"]),
    "density in kg/m3": (["--material", "H2O", "--density", "1000"], ["density", "g/cm³", "1000"]),
    "density alone": (["--density", "1"], ["--density", "--material"]),
    "material and ratio": (["--material", "haemoglobin", "--delta-beta", "2800"], ["--material", "--delta-beta"]),
    "ratio and density": (["--delta-beta", "2800", "--density", "1"], ["--density", "--delta-beta"]),
    "ratio and medium": (["--delta-beta", "2800", "--medium", "water"], ["--medium", "--delta-beta"]),
    "ratio of zero": (["--delta-beta", "0"], ["delta", "beta", "0"]),
    "same as its medium": (["--material", "water", "--medium", "water"], ["differ from its medium in δ"]),
    "missing config": (["--config", "none.json"], ["none.json"]),
    "config and preset": (["--config", "quick.json", "--preset", "fast"], ["--config", "--preset"]),
}


@pytest.mark.parametrize("fault", BAD_REQUESTS)
def test_bad_requests_are_refused_and_leave_no_run(shop, tmp_path, fault):
    options, words = BAD_REQUESTS[fault]
    with contextlib.chdir(shop.path):
        refused(holosplat("reconstruct", shop.scan, "--out", tmp_path / "run", *options), *words)
    assert list(tmp_path.iterdir()) == []


def test_outputs_that_cannot_be_are_refused_before_any_work(shop, tmp_path):
    """A taken folder, a file, and a folder in none; nothing changes, and nothing was computed."""
    (tmp_path / "file").write_text("mine")
    before = everything_in(tmp_path), everything_in(shop.run)
    for out, words in (
        (shop.run, ["--out", "new or empty", "--resume"]),
        (tmp_path / "file", ["--out", "file"]),
        (tmp_path / "none/run", ["existing folder"]),
    ):
        outcome = holosplat("reconstruct", shop.scan, "--out", out, *known(shop))
        refused(outcome, *words)
        assert "phase retrieval" not in outcome.err
    for out, words in ((tmp_path / "none/scan.nxs", "existing folder"), (tmp_path, "new or empty")):
        outcome = simulate(shop, "--views", 2, "--out", out)
        refused(outcome, str(out), words)
        assert "simulating" not in outcome.err
    refused(holosplat("render", shop.run, "--scan", shop.scan, "--out", tmp_path / "none/p.nxs"), "existing folder")
    refused(holosplat("export", shop.run, "--volume", tmp_path / "none/v.h5"), "existing folder")
    assert (everything_in(tmp_path), everything_in(shop.run)) == before


def test_a_truth_that_cannot_be_written_is_refused_before_the_scan_is_made(shop, tmp_path):
    outcome = simulate(shop, "--views", 2, "--out", tmp_path / "scan.nxs", "--truth", tmp_path / "none/truth.h5")
    refused(outcome, "truth.h5", "existing folder")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (
            ["--preset", "fast", "--material", "haemoglobin", "--seed", "5"],
            ["--resume", "settings"],
        ),
        (
            ["--material", "haemoglobin", "--matter", "levels", "--config", "quick.json", "--seed", "6"],
            ["--resume", "seed"],
        ),
        (
            ["--material", "water", "--matter", "levels", "--config", "quick.json", "--seed", "5"],
            ["--resume", "material"],
        ),
    ],
)
def test_resuming_with_other_options_is_refused(shop, options, words):
    before = everything_in(shop.run)
    with contextlib.chdir(shop.path):
        same = ("--out", shop.run, "--resume", "--matter", "levels")
        refused(holosplat("reconstruct", shop.scan, *same, *options), *words)
    assert everything_in(shop.run) == before


def test_resuming_with_another_scan_is_refused(shop, tmp_path):
    scan = read_scan(shop.scan)
    write_scan(tmp_path / "other.nxs", replace(scan, frames=scan.frames + np.float32(0.01)))
    before = everything_in(shop.run)
    outcome = holosplat("reconstruct", tmp_path / "other.nxs", "--out", shop.run, "--resume", *known(shop), "--seed", 5)
    refused(outcome, "--resume", "scan ")
    assert everything_in(shop.run) == before


def test_resuming_what_is_no_run_does_not_advise_to_resume(shop, tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    outcome = holosplat("reconstruct", shop.scan, "--out", tmp_path, "--resume", *known(shop))
    refused(outcome, str(tmp_path))
    assert "add --resume" not in outcome.err
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]
