"""`holosplat calibrate`: beads, a geometry that other commands take, and requests that cannot be met."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import holosplat as hs
from helpers.cli import holosplat, refused, worked
from helpers.polycube import polycube
from holosplat.cli.options import PriorOptions
from holosplat.geometry import rotation_y
from holosplat.io.beams import read_beams
from holosplat.io.nxtomo import read_scan, write_scan
from holosplat.io.vtk import write_mesh
from holosplat.specimens.red_cells import icosphere

PIXEL, SHAPE = 1e-6, (30, 33)
PLACES = np.array([[6.0, -5.0, 1.0], [-5.0, 4.0, 3.0], [0.0, 6.0, -6.0]])


@pytest.fixture(scope="module")
def scan(tmp_path_factory):
    """Three beads of polystyrene; the first view is shifted by a pixel, and the file does not know."""
    material = PriorOptions(("polystyrene",)).prior(20.0).materials[0]
    vertices, faces = icosphere(3)
    beads = [hs.mesh.TriangleMesh(PIXEL * (3.0 * vertices + place), faces) for place in PLACES]
    views = hs.Views.from_rotations(rotation_y([0.0, 40.0, 95.0]), SHAPE, PIXEL)
    planned = hs.Exposures.of(views, 20.0, 0.05, 0.3)
    shifts = PIXEL * np.array([[1.0, -0.5], [0.0, 0.0], [0.0, 0.0]])
    true = replace(planned, views=replace(views, shifts=shifts))
    matter = hs.MeshScene.of_one_material(beads, material)
    made = hs.simulate(matter, true, seed=0, is_test=np.zeros(3, dtype=bool))
    path = tmp_path_factory.mktemp("beads") / "beads.nxs"
    write_scan(path, hs.Scan(made.frames, planned, made.is_test))
    return path, true


def test_beads_give_a_geometry_that_other_commands_take(scan, tmp_path):
    (path, true), out = scan, tmp_path / "geometry.toml"
    unsure = ("--uncertain-angle", 0, "--uncertain-roll", 0, "--uncertain-distance", 0.02)
    done = worked(holosplat("calibrate", path, "--beads", 3e-6, "--material", "polystyrene", *unsure, "--out", out))
    assert "3 beads; unexplained share" in done.out
    beams = read_beams(out)
    assert beams.made_by["scan"] == str(path)
    assert beams.view[0].error is not None
    worked(holosplat("convert", path, tmp_path / "there.nxs", "--to", "nxtomo", "--exposures", out))
    there = read_scan(tmp_path / "there.nxs").views.shifts
    apart, wanted = (np.diff(shifts[:, 1]) for shifts in (there, true.views.shifts))
    np.testing.assert_allclose(apart, wanted, atol=0.05 * PIXEL)


def test_requests_that_cannot_be_met_are_refused(scan, tmp_path):
    path, out = scan[0], tmp_path / "geometry.toml"
    material = ("--material", "polystyrene")
    refused(holosplat("calibrate", path, *material, "--out", out), "--phantom", "--beads")
    refused(holosplat("calibrate", path, "--beads", 3e-6, "--out", out), "--material")
    refused(holosplat("calibrate", path, "--beads", 3e-6, *material, "--bin", 2, "--out", out), "--bin")
    refused(holosplat("calibrate", path, "--beads", 3e-7, *material, "--out", out), "a pixel at least")
    mesh = polycube(3e-6)
    write_mesh(tmp_path / "open.vtk", replace(mesh, faces=mesh.faces[:-2]))
    refused(holosplat("calibrate", path, "--phantom", tmp_path / "open.vtk", *material, "--out", out), "open.vtk")
    refused(holosplat("calibrate", path, "--phantom", tmp_path, *material, "--out", out), "name the file")
    assert not out.exists()
