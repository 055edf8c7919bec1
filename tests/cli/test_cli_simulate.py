"""`holosplat simulate`: the scan holds what was asked for."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from helpers.cli import BEAM, COLUMNS, MATTER, PIXEL, ROWS, holosplat, refused, simulate, worked
from holosplat.geometry import Grid, Views
from holosplat.io.beams import Beams, write_beams
from holosplat.io.nxtomo import read_scan
from holosplat.io.volumes import read_volume
from holosplat.io.vtk import read_meshes, write_mesh
from holosplat.materials import HAEMOGLOBIN, PLASMA, RED_CELL, Compound
from holosplat.mesh import TriangleMesh
from holosplat.scan import Exposures
from holosplat.specimens.red_cells import icosphere


def test_a_simulated_scan_holds_what_was_asked_for(shop):
    scan, exposures = read_scan(shop.scan), read_scan(shop.scan).exposures
    wanted = Views.evenly_spaced(8, (ROWS, COLUMNS), PIXEL)
    np.testing.assert_allclose(scan.views.rotations, wanted.rotations, atol=1e-12)
    assert (scan.views.shape, scan.views.pixel_size) == ((ROWS, COLUMNS), PIXEL)
    assert (set(exposures.energy_kev), set(exposures.distance)) == ({20.0}, {0.1})
    assert scan.is_test.tolist() == [False, False, False, True] * 2
    assert scan.provenance["materials"].startswith("delta 7.4")
    assert scan.frames.std() > 0.03
    truth = read_volume(shop.truth)
    assert truth.grid == Grid.of_views(wanted)
    volume = sum(mesh.volume for mesh in read_meshes(shop.cells, "um"))
    material = HAEMOGLOBIN.delta_beta(20)
    assert truth.delta.sum() * PIXEL**3 == pytest.approx(material.delta * volume, rel=0.01, abs=0)
    assert truth.beta.sum() * PIXEL**3 == pytest.approx(material.beta * volume, rel=0.01, abs=0)


def test_angles_may_be_listed_and_negative(shop, tmp_path):
    out = tmp_path / "scan.nxs"
    worked(simulate(shop, "--angles-deg", -30, "0", "45.5", "-1e1", "--out", out, "--test-every", 0))
    wanted = Views.from_angles([-30, 0, 45.5, -10], (ROWS, COLUMNS), PIXEL)
    np.testing.assert_allclose(read_scan(out).views.rotations, wanted.rotations, atol=1e-12)
    assert not read_scan(out).is_test.any()


def test_all_views_may_be_taken_at_several_distances(shop, tmp_path):
    out = tmp_path / "scan.nxs"
    beam = ("--detector", ROWS, COLUMNS, "--views", 3, "--test-every", 3, "--pixel-size", PIXEL)
    worked(holosplat("simulate", *shop.cells, *beam, "--distances", 0.1, "0", 0.3, "--out", out))
    found = read_scan(out)
    assert found.exposures.distance.tolist() == [0.1] * 3 + [0.0] * 3 + [0.3] * 3
    assert np.array_equal(found.views.rotations, np.tile(found.views.rotations[:3], (3, 1, 1)))
    assert found.is_test.tolist() == [False, False, True] * 3
    spread = found.frames.reshape(3, -1).std(axis=1)
    assert spread[2] > spread[0] > 10 * spread[1]


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (("--distance", 0.2), "distances says how far the detector is; leave"),
        (("--source-distance", 1, "--cone"), "distances is of parallel light; leave"),
    ],
)
def test_several_distances_that_contradict_are_refused(more, said, shop, tmp_path):
    beam = ("--detector", ROWS, COLUMNS, "--views", 3, "--distances", 0.1, 0.3)
    refused(holosplat("simulate", *shop.cells, *beam, *more, "--out", tmp_path / "scan.nxs"), said)
    assert not (tmp_path / "scan.nxs").exists()


def test_poses_may_be_matrices(shop, tmp_path):
    matrices = Views.from_angles([10, 80], (1, 1), 1.0).rotations
    np.save(tmp_path / "poses.npy", matrices)
    worked(simulate(shop, "--rotations", tmp_path / "poses.npy", "--out", tmp_path / "scan.nxs"))
    np.testing.assert_allclose(read_scan(tmp_path / "scan.nxs").views.rotations, matrices, atol=1e-12)


def test_poses_distances_and_pixels_may_be_those_of_a_geometry(shop, tmp_path):
    """As `align` and `calibrate` write it; what it says may not be said again."""
    views = Views.from_angles([10, 80, 30], (1, 1), 1.0)
    sizes = [3.2e-6, 3.4e-6, 3.0e-6]
    scaled = Views.of_pixels(views.rotations, np.full((3, 2), 1e-6), (ROWS, COLUMNS), np.array(sizes))
    true = Exposures(scaled, np.full(3, 20.0), np.array([0.05, 0.06, 0.07]), np.zeros(3), np.zeros(3))
    write_beams(tmp_path / "geometry.toml", Beams.of(true))
    given = ["--exposures", tmp_path / "geometry.toml", "--detector", ROWS, COLUMNS, "--out", tmp_path / "scan.nxs"]
    worked(holosplat("simulate", *shop.cells, *MATTER, *given))
    found = read_scan(tmp_path / "scan.nxs")
    np.testing.assert_allclose(found.views.rotations, views.rotations, atol=1e-12)
    np.testing.assert_allclose(found.views.shifts, scaled.shifts, rtol=1e-9)
    np.testing.assert_allclose(found.views.pixel_sizes, sizes, rtol=1e-9)
    np.testing.assert_allclose(found.exposures.distance, true.distance, rtol=1e-9)
    twice = holosplat("simulate", *shop.cells, *MATTER, *given, "--distance", 0.2, "--force")
    assert (twice.code, "says it already; leave --distance" in twice.err) == (2, True)
    more = holosplat("simulate", *shop.cells, *MATTER, *given, "--views", 3, "--force")
    assert (more.code, "says where views are" in more.err) == (2, True)


def test_photon_noise_follows_its_seed(shop, tmp_path):
    frames = []
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        options = ["--views", 2, "--photons-per-pixel", 1000, "--seed", seed, "--out", tmp_path / f"{name}.nxs"]
        worked(simulate(shop, *options))
        frames.append(read_scan(tmp_path / f"{name}.nxs").frames)
    clean = read_scan(shop.scan).frames[0]
    np.testing.assert_array_equal(frames[0], frames[1])
    assert not np.array_equal(frames[0], frames[2])
    assert (frames[0][0] - clean).std() == pytest.approx(1000**-0.5, rel=0.15)


def test_a_medium_is_subtracted_and_a_table_fills_each_mesh(shop, tmp_path):
    """Cells in plasma: Δβ < 0. A table of materials by file name overrides the one material."""
    options = ["--views", 1, "--test-every", 0, "--out", tmp_path / "scan.nxs", "--truth", tmp_path / "truth.h5"]
    worked(holosplat("simulate", *shop.cells, *BEAM, "--material", "red cell", "--medium", "plasma", *options))
    truth = read_volume(tmp_path / "truth.h5")
    contrast = RED_CELL.delta_beta(20).against(PLASMA.delta_beta(20))
    assert truth.delta.max() == pytest.approx(contrast.delta, rel=1e-3, abs=0)
    assert truth.beta.min() == pytest.approx(contrast.beta, rel=1e-3, abs=0)
    table = tmp_path / "materials.json"
    table.write_text(json.dumps({"*01.vtk": {"formula": "SiO2", "density": 2.2}}))
    worked(holosplat("simulate", *shop.cells, *MATTER, *BEAM, "--materials", table, *options, "--force"))
    truth = read_volume(tmp_path / "truth.h5").delta
    for matter in (HAEMOGLOBIN, Compound("SiO2", 2.2)):
        near = np.abs(truth / matter.delta_beta(20).delta - 1) < 1e-3
        assert near.sum() > 20


@pytest.fixture(scope="module")
def ball(tmp_path_factory) -> Path:
    """A ball of 15 µm radius about (-30, 12, 7.5) µm."""
    vertices, faces = icosphere(3)
    path = tmp_path_factory.mktemp("ball") / "ball.vtk"
    write_mesh(path, TriangleMesh(1e-6 * (15 * vertices + np.array([-30, 12, 7.5])), faces), "um")
    return path


@pytest.mark.parametrize(
    ("origin", "centre"),
    [
        (["--origin", "-30", "12", "7.5"], (0, 0, 0)),
        (["--origin", "-3.9e1", "16.5", "1.5"], (9, -4.5, 6)),
        ([], (0, 0, 0)),
    ],
)
def test_the_origin_is_the_point_on_the_axis_in_the_files_coordinates(ball, tmp_path, origin, centre):
    """In the true volume, and in the frames: at 0° x runs along columns and y along rows, at 90° z along columns."""
    options = ["--angles-deg", 0, 90, "--test-every", 0, "--out", tmp_path / "s.nxs", "--truth", tmp_path / "t.h5"]
    outcome = worked(holosplat("simulate", ball, *MATTER, *BEAM, *options, *origin))
    assert "warning" not in outcome.err
    truth = read_volume(tmp_path / "t.h5")
    z, y, x = np.meshgrid(*truth.grid.axes()[::-1], indexing="ij")
    found = [1e6 * float((axis * truth.delta).sum() / truth.delta.sum()) for axis in (x, y, z)]
    np.testing.assert_allclose(found, centre, atol=0.1)
    frames = np.abs(read_scan(tmp_path / "s.nxs").frames.astype(float) - 1)
    rows = (np.arange(ROWS) + 0.5 - ROWS / 2)[:, None] * 1e6 * PIXEL
    columns = (np.arange(COLUMNS) + 0.5 - COLUMNS / 2) * 1e6 * PIXEL
    for frame, column in zip(frames, (centre[0], centre[2])):
        assert (frame * rows).sum() / frame.sum() == pytest.approx(centre[1], abs=0.6)
        assert (frame * columns).sum() / frame.sum() == pytest.approx(column, abs=0.6)


def test_a_scene_beyond_the_detector_is_simulated_with_a_warning_that_says_by_how_much(ball, tmp_path):
    """The ball reaches 15 µm up and down; 8 rows show 12.8 µm: 2.2 µm are missing, 0.69 pixels."""
    beam = [*BEAM[:-2], "8", "28"]
    options = ["--views", 2, "--out", tmp_path / "scan.nxs"]
    outcome = worked(holosplat("simulate", ball, *MATTER, *beam, *options))
    assert re.search(
        r"warning: .* 2\.\d+ µm \(0\.6\d* pixels\) beyond the detector .*--detector.*--origin", outcome.err
    )
    assert read_scan(tmp_path / "scan.nxs").views.shape == (8, 28)
