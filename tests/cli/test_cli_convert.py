"""`holosplat convert`: there and back, and what it says when options and formats do not go together."""

from __future__ import annotations

import contextlib
import io
import json
import re
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from holosplat.cli import main
from holosplat.geometry import Views
from holosplat.io.nxtomo import read_scan, write_scan
from holosplat.scan import Exposures, Scan

N, H, W = 4, 15, 18
MATERIAL = ("--material", "haemoglobin")


@dataclass(frozen=True)
class Outcome:
    """What a command gave back; `said` is stderr on one line, without frames."""

    code: int
    err: str

    @property
    def said(self) -> str:
        return re.sub(r"[\s│╭╮╰╯─|]+", " ", self.err)


def convert(*arguments: object) -> Outcome:
    """Run the command within this process, where any exception but a clean exit fails the test."""
    err, before = io.StringIO(), sys.argv
    sys.argv = ["holosplat", "convert", *map(str, arguments)]
    code: object = 0
    try:
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(err):
            main()
    except SystemExit as end:
        code = end.code or 0
    finally:
        sys.argv = before
    assert isinstance(code, int)
    return Outcome(code, err.getvalue())


@pytest.fixture
def scan(tmp_path) -> Path:
    """A scan file of a dark disc, with one frame held out that is brighter than the others."""
    y, x = np.meshgrid(np.arange(H) - 7.0, np.arange(W) - 8.5, indexing="ij")
    frames = np.tile(1 - 0.2 * (x**2 + y**2 < 20), (N, 1, 1)) + 0.01 * np.arange(N)[:, None, None]
    exposures = Exposures.of(Views.evenly_spaced(N, (H, W), 3.2e-6), 20.0, 0.1)
    write_scan(tmp_path / "scan.nxs", Scan(frames, exposures, np.arange(N) == N - 1, {"made_by": "hand"}))
    return tmp_path / "scan.nxs"


@pytest.mark.parametrize(
    ("to", "options", "tolerance"),
    [
        ("tiff", (), 0),
        ("tiff", ("--tiff", "files"), 0),
        ("nxtomo", (), 0),
        ("nerf-synthetic", ("--seed-points", 50), 0.3 / 65535),
        ("nerf-synthetic", ("--png", "rgba8", "--camera-distance", 500, *MATERIAL), 0.3 / 255),
    ],
)
def test_there_and_back(scan, tmp_path, to, options, tolerance):
    there = convert(scan, "--to", to, tmp_path / "there", *options)
    assert there.code == 0, there.err
    assert "4 frames of 15 × 18 pixels, 1 of them held out" in there.said
    back = convert(tmp_path / "there", "--to", "nxtomo", tmp_path / "back.nxs")
    assert back.code == 0, back.err
    before, after = read_scan(scan), read_scan(tmp_path / "back.nxs")
    assert np.allclose(before.train().frames, after.train().frames, rtol=0, atol=tolerance)
    assert np.array_equal(before.views.rotations, after.views.rotations)
    assert np.array_equal(before.is_test, after.is_test)
    assert before.provenance == after.provenance
    cut = int((before.test().frames > before.train().frames.max()).sum())
    assert cut > 0
    assert (f"{cut} of {H * W} held-out pixels" in there.said) == (to == "nerf-synthetic")


@pytest.mark.parametrize("known", [MATERIAL, ("--delta-beta", "1200")])
def test_r2_gaussian_there_and_back(scan, tmp_path, known):
    """The scene's density is that of the material, or such that half the field is the greatest thickness."""
    there = convert(scan, tmp_path / "there", "--to", "r2-gaussian", "--seed-points", 50, *known)
    assert there.code == 0, there.err
    meta = json.loads((tmp_path / "there/meta_data.json").read_text())
    images = [np.load(tmp_path / "there" / entry["file_path"]) for entry in meta["proj_train"] + meta["proj_test"]]
    if known != MATERIAL:
        assert np.max(images) == pytest.approx(1, rel=1e-5)
    back = convert(tmp_path / "there", tmp_path / "back.nxs", "--to", "nxtomo")
    assert back.code == 0, back.err
    assert "has no phase" in back.said
    after = read_scan(tmp_path / "back.nxs")
    top, left = meta["holosplat"]["corner"]
    expected = np.exp(-np.stack(images))[:, top : top + H, left : left + W]
    assert np.allclose(after.frames, expected, atol=1e-6)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--to", "r2-gaussian"), "needs --material or --delta-beta"),
        (("--to", "tiff", "--png", "grey16"), "--png goes with --to nerf-synthetic"),
        (("--to", "tiff", "--seed-points", "5"), "--seed-points goes with --to nerf-synthetic or r2-gaussian"),
        (("--to", "tiff", *MATERIAL), "a material is not needed with --to tiff"),
        (("--to", "nerf-synthetic", "--truth", "t.h5"), "--truth goes with --to r2-gaussian"),
        (("--to", "tiff", "--black", "0.1"), "black: not for a source in nxtomo"),
        (("--to", "r2-gaussian", *MATERIAL, "--truth", "none.h5"), "no such file"),
        (("--to", "nerf-synthetic", "--camera-distance", "1"), "camera_distance must be at least 10"),
        (("--to", "jpeg"), "--to must be one of nxtomo"),
        ((), "required"),
    ],
)
def test_options_that_do_not_go_together(scan, tmp_path, arguments, message):
    outcome = convert(scan, tmp_path / "out", *arguments)
    assert outcome.code == 2
    assert message in outcome.said
    assert not (tmp_path / "out").exists()


def test_the_suffix_says_the_format(scan, tmp_path):
    found = convert(scan, tmp_path / "out.nxs")
    assert found.code in (0, None), found.said
    np.testing.assert_array_equal(read_scan(tmp_path / "out.nxs").frames, read_scan(scan).frames)


def test_nothing_is_overwritten_nor_guessed(scan, tmp_path):
    before = scan.read_bytes()
    again = convert(scan, scan, "--to", "nxtomo")
    assert (again.code, scan.read_bytes()) == (2, before)
    assert "OUT must not be what the command reads" in again.said
    nothing = convert(tmp_path, "--to", "nxtomo", tmp_path / "out.nxs")
    assert nothing.code == 2
    assert "an HDF5 file (nxtomo); an HDF5 file with " in nothing.said


def test_folders_of_others_need_what_they_do_not_say(scan, tmp_path):
    for to, table, options in (
        ("nerf-synthetic", "transforms_train.json", ("--seed-points", 5)),
        ("r2-gaussian", "meta_data.json", MATERIAL),
    ):
        folder = tmp_path / to
        assert convert(scan, folder, "--to", to, *options).code == 0
        (folder / "transforms_test.json").unlink(missing_ok=True)
        values = json.loads((folder / table).read_text())
        del values["holosplat"]
        (folder / table).write_text(json.dumps(values))
        assert "--" in convert(folder, tmp_path / "back.nxs", "--to", "nxtomo").said
        partly = convert(folder, tmp_path / "back.nxs", "--to", "nxtomo", "--energy-kev", 12)
        assert partly.code == 2
        assert "by --" in partly.said
        all_of_it = ["--energy-kev", 12, "--pixel-size", 1e-6]
        if to == "nerf-synthetic":
            all_of_it += ["--distance", 0.2, "--black", 0.5]
        outcome = convert(folder, tmp_path / f"{to}.nxs", "--to", "nxtomo", *all_of_it)
        assert outcome.code == 0, outcome.err
        found = read_scan(tmp_path / f"{to}.nxs")
        assert (found.exposures.one_energy("it"), found.views.pixel_size) == (12, 1e-6)
        assert len(found) == (N - 1 if to == "nerf-synthetic" else N)
    stray = convert(tmp_path / "r2-gaussian", tmp_path / "x.nxs", "--to", "nxtomo", "--distance", 1)
    assert "distance: not for a source in r2-gaussian" in stray.said
