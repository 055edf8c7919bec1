"""`holosplat align`: scans whose beams are elsewhere."""

from __future__ import annotations

import csv
from dataclasses import replace

import numpy as np
import pytest

from helpers.cli import FORMULA, holosplat, refused, worked
from helpers.contact import PIXEL, contact_scan
from holosplat.io.nxtomo import read_scan, write_scan

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


def test_single_views_are_moved_and_told(shop, tmp_path):
    """Of the shared scan, whose views are said to be moved by a pixel."""
    scan = read_scan(shop.scan)
    moved = scan.views.shifts + scan.views.pixel_size * np.array([1.0, 0]) * (-1.0) ** np.arange(len(scan))[:, None]
    path, out, table = (tmp_path / name for name in ("moved.nxs", "aligned.nxs", "views.csv"))
    write_scan(path, scan.with_views(replace(scan.views, shifts=moved)))
    known = ("--material", FORMULA, "--density", "1.335")
    unsure = ("--uncertain-shift", 2, "--uncertain-angle", 0, "--uncertain-roll", 0)
    done = worked(holosplat("align", path, *known, *unsure, "--table", table, "--out", out))
    assert "changes of the plan" in done.out
    found = read_scan(out)
    np.testing.assert_array_equal(found.frames, scan.frames)
    np.testing.assert_allclose(found.views.rotations, scan.views.rotations, atol=1e-9)
    away = [np.abs(np.diff((shifts - scan.views.shifts)[:, 0])).mean() for shifts in (moved, found.views.shifts)]
    before, after = away
    assert after < 0.5 * before
    rows = list(csv.DictReader(table.open()))
    assert len(rows) == len(scan)
    assert float(rows[0]["after"]) < float(rows[0]["before"])
    assert found.provenance["aligned"].startswith("changes of the plan")


def test_requests_that_cannot_be_met_are_refused(turning, tmp_path):
    path, scan = turning
    out = tmp_path / "aligned.nxs"
    refused(holosplat("align", path, "--axis-only", "--out", path), "name another file")
    refused(holosplat("align", path, "--axis-only", "--table", tmp_path / "t.csv", "--out", out), "--table")
    refused(holosplat("align", path, "--uncertain-shift", -1, "--out", out), "shift")
    few = tmp_path / "few.nxs"
    write_scan(few, scan[[0, 1, 2]])
    refused(holosplat("align", few, "--axis-only", "--out", out), "6 views")
    moved = scan.views.shifts + np.array([0, 1]) * PIXEL * np.arange(len(scan))[:, None]
    write_scan(few, scan.with_views(replace(scan.views, shifts=moved)))
    refused(holosplat("align", few, "--axis-only", "--out", out), "y axis alone")
    assert not out.exists()
