"""`holosplat align`: scans whose beams are elsewhere."""

from __future__ import annotations

import csv
import json
from dataclasses import replace

import numpy as np
import pytest

import holosplat as hs
from helpers.cli import FORMULA, QUICK, holosplat, known, refused, worked
from helpers.contact import PIXEL, contact_scan
from helpers.moving_balls import beams, series
from holosplat.align import PoseOptions, PosePrior
from holosplat.beamline.misalignment import Misalignment
from holosplat.cli.options import PriorOptions
from holosplat.io.nxtomo import read_scan, write_scan
from holosplat.workflows.run_folder import RunFolder

pytestmark = pytest.mark.usefixtures("unjudged_runs")

BALLS = ((7.0, -3.0, 4.0, 6.0, 2e-9), (-9.0, 4.0, 5.0, 5.0, 3e-9), (2.0, 6.0, -9.0, 4.0, 4e-9))


@pytest.fixture(scope="module")
def turning(tmp_path_factory):
    """A scan of balls about column 24 of 49, whose file says that they turn about column 21."""
    scan = contact_scan(BALLS, (27, 49), 36, test_every=6)
    path = tmp_path_factory.mktemp("turning") / "scan.nxs"
    write_scan(path, scan.with_views(scan.views.about_column(21.0)))
    return path, scan


def test_the_axis_is_written_into_the_same_frames(turning, tmp_path):
    (path, true), out = turning, tmp_path / "aligned.nxs"
    done = worked(holosplat("align", path, "--axis-only", "--out", out))
    assert "axis at column 24.0" in done.out
    assert "cannot tell" in done.out
    found, before = read_scan(out), read_scan(path)
    np.testing.assert_array_equal(found.frames, before.frames)
    np.testing.assert_array_equal(found.is_test, before.is_test)
    np.testing.assert_allclose(found.views.shifts, true.views.shifts, atol=0.03 * PIXEL)
    np.testing.assert_allclose(found.views.rotations, true.views.rotations, atol=1e-9)
    assert "axis at column" in found.provenance["aligned"]


def test_a_first_guess_may_be_given(turning, tmp_path):
    """And what is written is in the frames that were asked for."""
    path, out = turning[0], tmp_path / "aligned.nxs"
    done = worked(holosplat("align", path, "--axis-only", "--axis-column", 27, "--crop", "3:24,:", "--out", out))
    assert "axis at column 24.0" in done.out
    assert read_scan(out).views.shape == (21, 49)


def moved(shop, path):
    """The shared scan at `path`, whose views are said to be moved by a pixel, and how far they are."""
    scan = read_scan(shop.scan)
    shifts = scan.views.shifts + scan.views.pixel_size * np.array([1.0, 0]) * (-1.0) ** np.arange(len(scan))[:, None]
    write_scan(path, scan.with_views(replace(scan.views, shifts=shifts)))
    return path


def test_a_run_refines_its_geometry_and_keeps_it(shop, tmp_path):
    """Training frames before the fit, held-out ones after it; what reads the run knows where its frames are."""
    path, run, frames = moved(shop, tmp_path / "moved.nxs"), tmp_path / "run", tmp_path / "frames.nxs"
    how = ("--refine", "shifts", "--seed", 5)
    done = worked(holosplat("reconstruct", path, "--out", run, *known(shop), *how))
    assert "shifts refined" in done.out
    planned, true = read_scan(path), read_scan(shop.scan)
    geometry = json.loads((run / "summary.json").read_text())["geometry"]
    found = np.array(geometry["shifts"])
    for chosen in (~true.is_test, true.is_test):
        before, after = (np.ptp((shifts - true.views.shifts)[chosen, 0]) for shifts in (planned.views.shifts, found))
        assert after < 0.5 * max(before, true.views.pixel_size)
    np.testing.assert_allclose(geometry["rotations"], true.views.rotations, atol=1e-9)
    assert "geometry" in (run / "metrics.csv").read_text().splitlines()[0].split(",")  # it was free in the fit, too
    assert "Geometry beside the plan" in (run / "report.html").read_text()
    assert "not the scan" not in worked(holosplat("evaluate", run, "--json")).err
    worked(holosplat("render", run, "--scan", path, "--split", "all", "--out", frames))
    np.testing.assert_allclose(read_scan(frames).views.shifts, found, atol=1e-12)
    refine = PoseOptions(PosePrior(angle=0.0, roll=0.0))
    options = {"matter": "levels", "refine": refine, "folder": RunFolder(run), "resume": True}
    again = hs.reconstruct(
        planned, PriorOptions(("haemoglobin",)).prior(planned.exposures.reference_energy), QUICK, 5, **options
    )
    np.testing.assert_array_equal(again.placed(planned).views.shifts, found)
    refused(holosplat("reconstruct", path, "--out", run, *known(shop), "--seed", 5, "--resume"), "refinement")


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--refine", "tilt"), "tilt"),
        (("--uncertain-shift", 3), "--refine"),
        (("--refine", "shifts", "--distance", "0.05:0.2"), "distance"),
    ],
)
def test_refinements_that_make_no_sense_are_refused(shop, tmp_path, options, said):
    refused(holosplat("reconstruct", shop.scan, "--out", tmp_path / "run", *known(shop), *options), said)


def test_single_views_are_moved_and_told(shop, tmp_path):
    """Of the shared scan, whose views are said to be moved by a pixel."""
    scan = read_scan(shop.scan)
    path, out, table, geometry = (
        tmp_path / name for name in ("moved.nxs", "aligned.nxs", "views.csv", "geometry.toml")
    )
    planned = read_scan(moved(shop, path)).views.shifts
    matter = ("--material", FORMULA, "--density", "1.335")
    unsure = ("--uncertain-shift", 2, "--uncertain-angle", 0, "--uncertain-roll", 0)
    written = ("--table", table, "--geometry-out", geometry, "--out", out)
    done = worked(holosplat("align", path, *matter, *unsure, *written))
    assert "changes of the plan" in done.out
    found = read_scan(out)
    np.testing.assert_array_equal(found.frames, scan.frames)
    np.testing.assert_allclose(found.views.rotations, scan.views.rotations, atol=1e-9)
    away = [np.abs(np.diff((shifts - scan.views.shifts)[:, 0])).mean() for shifts in (planned, found.views.shifts)]
    before, after = away
    assert after < 0.5 * before
    rows = list(csv.DictReader(table.open()))
    assert len(rows) == len(scan)
    assert float(rows[0]["after"]) < float(rows[0]["before"])
    assert found.provenance["aligned"].startswith("changes of the plan")
    worked(holosplat("convert", path, tmp_path / "there.nxs", "--to", "nxtomo", "--exposures", geometry))
    there = read_scan(tmp_path / "there.nxs")
    np.testing.assert_allclose(there.views.shifts, found.views.shifts, atol=1e-15)
    np.testing.assert_allclose(there.views.rotations, found.views.rotations, atol=1e-15)


def test_the_geometry_of_a_part_is_that_of_whole_frames(turning, tmp_path):
    """It is found on larger pixels of fewer rows and columns, and serves the whole scan."""
    (path, true), geometry, out = turning, tmp_path / "geometry.toml", tmp_path / "whole.nxs"
    part = ("--crop", "2:22,4:46", "--bin", 2)
    worked(holosplat("align", path, "--axis-only", *part, "--geometry-out", geometry, "--out", tmp_path / "part.nxs"))
    worked(holosplat("convert", path, out, "--to", "nxtomo", "--exposures", geometry))
    np.testing.assert_allclose(read_scan(out).views.shifts, true.views.shifts, atol=0.1 * PIXEL)
    few = ("--views", "0:36:2", "--geometry-out", geometry, "--force")
    refused(holosplat("align", path, "--axis-only", *few, "--out", tmp_path / "few.nxs"), "--geometry-out", "--views")


def test_a_series_has_one_geometry_and_its_reversed_beam_is_turned_back(tmp_path):
    """The geometry serves every time of another series of these beams."""
    scan, _ = series(beams((0.0, 30.0, 48.0)), Misalignment(1.0, 0.6, 0.0, seed=2), 3)
    frames = scan.frames.copy()
    frames[2::3] = frames[2::3, ::-1]
    path, upside, out, geometry = (tmp_path / name for name in ("s.nxs", "u.nxs", "a.nxs", "geometry.toml"))
    write_scan(path, scan)
    write_scan(upside, replace(scan, frames=frames))
    matter = ("--delta-beta", 1000)
    done = worked(holosplat("align", path, *matter, "--geometry-out", geometry, "--out", out))
    assert "3 beams, from 3 times" in done.out
    found = read_scan(out)
    worked(holosplat("convert", path, tmp_path / "there.nxs", "--to", "nxtomo", "--exposures", geometry))
    np.testing.assert_allclose(read_scan(tmp_path / "there.nxs").views.shifts, found.views.shifts, atol=1e-15)
    refused(holosplat("align", upside, *matter, "--geometry-out", geometry, "--out", out, "--force"), "reversed")
    every = ("--time-frame", "all", "--refine", "shifts", "--out", tmp_path / "run")
    refused(holosplat("reconstruct", path, *matter, *every), "--refine", "--motion flow", "holosplat align")
    done = worked(holosplat("align", upside, *matter, "--out", out, "--force"))
    assert "beam 2 is reversed along y" in done.out
    np.testing.assert_array_equal(read_scan(out).frames, scan.frames)


def test_requests_that_cannot_be_met_are_refused(turning, tmp_path):
    path, scan = turning
    out = tmp_path / "aligned.nxs"
    refused(holosplat("align", path, "--axis-only", "--out", path), "must not be what the command reads")
    refused(holosplat("align", path, "--axis-only", "--table", tmp_path / "t.csv", "--out", out), "--table")
    refused(holosplat("align", path, "--uncertain-shift", -1, "--out", out), "shift")
    few = tmp_path / "few.nxs"
    write_scan(few, scan[[0, 1, 2]])
    refused(holosplat("align", few, "--axis-only", "--out", out), "6 views")
    moved = scan.views.shifts + np.array([0, 1]) * PIXEL * np.arange(len(scan))[:, None]
    write_scan(few, scan.with_views(replace(scan.views, shifts=moved)))
    refused(holosplat("align", few, "--axis-only", "--out", out), "y axis alone")
    assert not out.exists()
