"""Constants that are said as ranges, on the command line: what is found is printed, kept, and used by what follows."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from helpers.blobs import MATERIAL, blob_scan
from helpers.cli import holosplat, refused, worked
from holosplat.baselines import HolographicTV
from holosplat.io.nxtomo import write_scan
from holosplat.methods import uncertain
from holosplat.methods.profile import ProfileOptions
from holosplat.tables import read_rows

pytestmark = pytest.mark.usefixtures("unjudged_runs")

METHOD = ("--method", "paganin-tv")


@pytest.fixture
def scan(tmp_path, monkeypatch):
    """Six views at 0.12 m whose file says half of that; constants are looked for in a hurry."""
    start = HolographicTV(retrieval=4, iterations=4, corrections=0, noisy=1.0, refine=1, upper=0.0)
    monkeypatch.setattr(uncertain, "ProfileOptions", lambda: ProfileOptions(iterations=3, start=start))
    for name, few in (("FEW", 3), ("MANY", 3), ("NEWTON", 1)):
        monkeypatch.setattr(uncertain, name, few)
    write_scan(tmp_path / "scan.nxs", blob_scan(0.12))
    return tmp_path / "scan.nxs"


def test_a_range_of_distances_is_fitted_kept_and_used(scan, tmp_path):
    run = tmp_path / "run"
    said = ("--distance", "0.06:0.2", "--delta-beta", MATERIAL.ratio)
    done = worked(holosplat("reconstruct", scan, "--out", run, *METHOD, *said))
    assert "distance 0.1" in done.out
    assert "given: 0.06 to 0.2 m" in done.out
    summary = json.loads((run / "summary.json").read_text())
    (constant,) = summary["constants"]
    assert 0.06 <= constant["low"] <= constant["value"] <= constant["high"] <= 0.2
    source = json.loads((run / "source.json").read_text())
    assert source["reading"]["distance"] == pytest.approx(constant["value"])
    again = worked(holosplat("evaluate", run, "--json"))
    assert "not the scan that was reconstructed" not in again.err


def test_times_of_a_range_are_judged_in_the_end(scan, tmp_path):
    """Of all times as one: each is read again, with the distance that was found."""
    once = blob_scan(0.12)
    write_scan(tmp_path / "times.nxs", replace(once, exposures=replace(once.exposures, time=np.repeat([0.0, 1e-3], 3))))
    said = ("--distance", "0.06:0.2", "--delta-beta", MATERIAL.ratio, "--motion", "still")
    worked(holosplat("reconstruct", tmp_path / "times.nxs", "--out", tmp_path / "run", *METHOD, *said))
    rows = read_rows(tmp_path / "run" / "times.csv", "")
    assert [float(row["time_s"]) for row in rows] == [0.0, 1e-3]
    assert (tmp_path / "run" / "report.html").is_file()


def test_a_range_of_ratios_is_a_ratio_then(scan, tmp_path):
    run = tmp_path / "run"
    done = worked(holosplat("reconstruct", scan, "--out", run, *METHOD, "--delta-beta", "500:2000"))
    assert "δ/β" in done.out
    summary = json.loads((run / "summary.json").read_text())
    (constant,) = summary["constants"]
    found = summary["material"]["delta"] / summary["material"]["beta"]
    assert found == pytest.approx(constant["value"], rel=1e-3)


@pytest.mark.parametrize(
    ("command", "option", "said"),
    [
        ("reconstruct", ("--distance", "0.2:0.1"), "--distance must be a number, or a range LOW:HIGH"),
        ("reconstruct", ("--energy-kev", "far"), "--energy-kev must be a number, or a range LOW:HIGH"),
        ("reconstruct", ("--delta-beta", "1:2:3"), "--delta-beta must be a number, or a range LOW:HIGH"),
        ("reconstruct", ("--delta-beta", "1:2", "--material", "H2O", "--density", "1"), "not both"),
        ("convert", ("--distance", "0.1:0.2"), "--distance must be one number here, but it is '0.1:0.2'"),
    ],
)
def test_what_is_no_range_is_refused(scan, tmp_path, command, option, said):
    out = tmp_path / "out.nxs"
    place = ("--out", out) if command == "reconstruct" else (out, "--to", "tiff")
    refused(holosplat(command, scan, *place, *option), said)
    assert not out.exists()
