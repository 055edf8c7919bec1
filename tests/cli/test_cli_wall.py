"""Runs beside a known wall on the command line: they are read again, as any run is."""

from __future__ import annotations

from dataclasses import replace

import h5py
import numpy as np
import pytest

import holosplat as hs
from helpers.cli import holosplat, refused, worked
from holosplat.materials import parse_material, require_in_wall, wall_of
from holosplat.model import measure
from holosplat.workflows import certainty

pytestmark = pytest.mark.usefixtures("unjudged_runs")

WALL = ("--wall", "tube:12e-6:15e-6:glass:water", "--material", "air", "--medium", "water")


@pytest.fixture(scope="module")
def scan(tmp_path_factory):
    """Four frames of a bubble in a tube of water."""
    path = tmp_path_factory.mktemp("wall") / "scan.nxs"
    air, water = (hs.materials.parse_material(name).delta_beta(20.0) for name in ("air", "water"))
    bubble = hs.specimens.random_cells(1, (8e-6, 8e-6, 8e-6), 1, 6e-6)
    inside = hs.MeshScene.of_one_material(bubble, air.against(water))
    exposures = hs.Exposures.of(hs.Views.evenly_spaced(4, (13, 24), 1e-6), 20.0, 0.03)
    beside = replace(exposures, wall=wall_of(WALL[1], 20.0))
    hs.write_scan(path, hs.Scan(measure(inside, beside).numpy(), exposures, np.arange(4) == 3))
    return path


@pytest.fixture(scope="module", params=["tube", "cuvette"])
def run(request, scan, tmp_path_factory):
    out = tmp_path_factory.mktemp(request.param) / "run"
    wall = (WALL[0], WALL[1].replace("tube", request.param), *WALL[2:])
    worked(holosplat("reconstruct", scan, *wall, "--method", "ctf-tv", "--out", out))
    return out


def test_a_run_is_read_again(run, tmp_path, monkeypatch):
    monkeypatch.setattr(certainty, "MISTAKES", {})
    worked(holosplat("evaluate", run))
    worked(holosplat("export", run, "--volume", tmp_path / "volume.h5"))
    with h5py.File(tmp_path / "volume.h5") as file:
        assert file["delta"].size > 0
    assert "differs by 0 %" in worked(holosplat("compare", run, run, "--out", tmp_path / "page.html")).out
    worked(holosplat("rehearse", run, "--times", 2))
    worked(holosplat("reconstruct", "--resume", run))


def test_the_filling_is_told_and_is_the_medium(scan, tmp_path):
    out, said = tmp_path / "run", ("--material", "air", "--medium", "water")
    for wall, medium, words in (
        ("tube:12e-6:15e-6:glass", said, "with FILLING as the --medium (or vacuum)"),
        (
            "tube:12e-6:15e-6:glass:air",
            said,
            "FILLING of --wall must be the --medium that matter lies in, but it is air",
        ),
        ("tube:12e-6:15e-6:glass:water", ("--material", "PMMA"), "must be the --medium that matter lies in"),
    ):
        refused(holosplat("reconstruct", scan, "--wall", wall, *medium, "--out", out), words)
    assert not out.exists()
    for wall in ("slab:1e-5:glass:5.8e-7,2.6e-10", "slab:1e-5:glass:Water"):
        require_in_wall(wall, parse_material("water"))
    require_in_wall("slab:1e-5:glass:vacuum", None)
