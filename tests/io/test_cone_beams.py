"""Sources at a finite distance: effective pixel and distance of every foreign file, Nikon's among them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile

import holosplat as hs
from helpers.cli import holosplat, worked
from holosplat.align.axis import find_axis
from holosplat.checks import InputError
from holosplat.geometry import Views
from holosplat.io.formats import read, read_as
from holosplat.io.images import write_tiff
from holosplat.io.nxtomo import write_scan
from holosplat.io.reading import Reading, Told
from holosplat.io.vtk import write_mesh
from holosplat.optics.coherence import effective_geometry
from holosplat.scan import Exposures, Scan
from holosplat.specimens.red_cells import icosphere
from holosplat.workflows.join import join
from holosplat_bench.formats.nerf_synthetic import write_nerf_synthetic
from holosplat_bench.opponents.neural_fields import NeuralFields

SOURCE, BEHIND, PIXEL = 0.25, 0.75, 4e-6
WANTED = effective_geometry(SOURCE, BEHIND, PIXEL)
SHAPE = (11, 14)


def a_folder(path: Path, count: int = 3) -> Path:
    path.mkdir()
    for n in range(count):
        tifffile.imwrite(path / f"capsule_{n + 1:04d}.tif", np.full(SHAPE, 30000 + 1000 * n, dtype=np.uint16))
    return path


def nikon(folder: Path, change: dict[str, str] | None = None) -> Path:
    """A file as a scanner writes it, lengths in mm."""
    entries = {
        **{"Name": "capsule", "SrcToObject": "250.0", "SrcToDetector": "1000", "DetectorPixelsX": "14"},
        **{"DetectorPixelsY": "11", "DetectorPixelSizeX": "0.004", "DetectorPixelSizeY": "0.004"},
        **{"Projections": "3", "InitialAngle": "-3.5", "AngularStep": "0.25", "WhiteLevel": "60000"},
        **(change or {}),
    }
    text = "\r\n".join(["[XTekCT]", *(f"{name}={value}" for name, value in entries.items() if value)])
    (folder / "scan.xtekct").write_text(f"{text}\r\n\r\n[Xrays]\r\nXraykV=120\r\n")
    return folder / "scan.xtekct"


def test_a_nikon_file_is_read_with_its_images(tmp_path: Path):
    found = read(nikon(a_folder(tmp_path / "run")), {"energy_kev": 60.0})
    exposures = found.exposures
    assert exposures.views.pixel_size == pytest.approx(WANTED.pixel_size, rel=1e-12)
    assert exposures.distance == pytest.approx([WANTED.distance] * 3, rel=1e-12)
    angles = np.rad2deg(np.arctan2(exposures.views.rotations[:, 0, 2], exposures.views.rotations[:, 0, 0]))
    assert angles == pytest.approx([-3.5, -3.25, -3.0])
    assert found.frames[:, 4, 5] == pytest.approx(np.array([0.5, 31 / 60, 32 / 60]), rel=1e-6)
    told = read(tmp_path / "run/scan.xtekct", {"energy_kev": 60.0, "pixel_size": 2e-6}).exposures
    assert told.views.pixel_size == 2e-6  # effective, as it is said everywhere
    assert told.distance == pytest.approx([WANTED.distance] * 3, rel=1e-12)


def test_a_nikon_file_finds_its_images_in_another_folder(tmp_path: Path):
    a_folder(tmp_path / "raw")
    assert len(read(nikon(tmp_path, {"InputFolderName": "raw"}), {"energy_kev": 60.0})) == 3


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"SrcToObject": ""}, "SrcToObject must be a number, but it is missing"),
        ({"AngularStep": "a"}, "AngularStep must be a number, but it is a"),
        ({"Projections": "4"}, "Projections must be the number of images named capsule, 3, but it is 4"),
        ({"SrcToDetector": "200"}, "SrcToDetector must be above SrcToObject"),
        ({"DetectorPixelSizeY": "0.005"}, "detector pixels must be square"),
        ({"WhiteLevel": "0"}, "WhiteLevel must be above 0"),
        ({"Name": "other"}, "images whose names begin with 'other', but it holds none"),
        ({"InputFolderName": "gone"}, "InputFolderName must be a folder"),
    ],
)
def test_nikon_files_that_cannot_be_are_refused(change, said, tmp_path: Path):
    with pytest.raises(InputError, match=said):
        read(nikon(a_folder(tmp_path / "run"), change), {"energy_kev": 60.0})


@pytest.mark.parametrize("text", ["no section", "[Other]\na=1\n"])
def test_what_is_no_nikon_file_is_refused(text, tmp_path: Path):
    (tmp_path / "scan.xtekct").write_text(text)
    with pytest.raises(InputError, match=r"scan\.xtekct must (be a text file of|have a section)"):
        read(tmp_path / "scan.xtekct", {"energy_kev": 60.0})


def test_a_source_that_is_said_makes_images_parallel(tmp_path: Path):
    (tmp_path / "angles.txt").write_text("0\n1\n2\n")
    told = Told(20.0, distance=BEHIND, pixel_size=PIXEL, source_distance=SOURCE, angles=tmp_path / "angles.txt")
    found = read_as(a_folder(tmp_path / "run"), Reading(told)).exposures
    assert (found.views.pixel_size, found.distance[0]) == pytest.approx((WANTED.pixel_size, WANTED.distance), rel=1e-12)


@pytest.mark.parametrize("said", [{}, {"distance": BEHIND}, {"distance": BEHIND, "pixel_size": PIXEL}])
def test_a_source_that_is_said_goes_before_that_of_a_file(said, tmp_path: Path):
    """Both make the same parallel beam, once."""
    views = Views.evenly_spaced(2, shape=SHAPE, pixel_size=PIXEL)
    write_scan(tmp_path / "s.nxs", Scan(np.ones((2, *SHAPE)), Exposures.of(views, 20.0, BEHIND), np.zeros(2)))
    own = read(tmp_path / "s.nxs", {"source_distance": SOURCE, **said}).exposures
    with h5py.File(tmp_path / "s.nxs", "a") as file:
        file["entry/instrument/source/distance"] = -2.0
    both = read(tmp_path / "s.nxs", {"source_distance": SOURCE, **said}).exposures
    for found in (own, both):
        assert found.views.pixel_size == pytest.approx(WANTED.pixel_size, rel=1e-12)
        assert found.distance == pytest.approx([WANTED.distance] * 2, rel=1e-12)


# --- cones whose rays are not parallel at the object --------------------------------------------------------


def test_a_source_nearby_makes_a_cone_of_rays(tmp_path: Path):
    """Half of 14 pixels of 0.4 mm, 10 mm away, are a tangent of 0.28, and so are they at the object."""
    (tmp_path / "angles.txt").write_text("0\n1\n2\n")
    told = Told(20.0, distance=0.005, pixel_size=4e-4, source_distance=0.005, angles=tmp_path / "angles.txt")
    found = read_as(a_folder(tmp_path / "run"), Reading(told)).exposures
    assert found.views.sources is not None
    assert found.views.sources.tolist() == [0.005] * 3
    assert (found.views.pixel_size, found.distance[0]) == pytest.approx((2e-4, 0.0025), rel=1e-12)
    wide = {"SrcToObject": "5", "SrcToDetector": "10", "DetectorPixelSizeX": "0.4", "DetectorPixelSizeY": "0.4"}
    own = read(nikon(tmp_path / "run", wide), {"energy_kev": 20.0}).exposures.views
    assert own.sources is not None
    assert own.sources == pytest.approx([0.005] * 3)
    assert read(nikon(tmp_path / "run"), {"energy_kev": 20.0}).exposures.views.sources is None


def test_sizes_at_the_sample_do_not_make_rays_parallel(tmp_path: Path):
    """A file that says both what it measured at the sample and a source nearby, or a pixel size that is told."""
    views = Views.evenly_spaced(2, shape=SHAPE, pixel_size=PIXEL)
    write_scan(tmp_path / "s.nxs", Scan(np.ones((2, *SHAPE)), Exposures.of(views, 20.0, BEHIND), np.zeros(2)))
    with h5py.File(tmp_path / "s.nxs", "a") as file:
        file["entry/instrument/source/distance"] = -20 * max(SHAPE) * PIXEL
        for axis in "xy":
            file[f"entry/sample/{axis}_pixel_size"] = PIXEL
        file["entry/sample/propagation_distance"] = BEHIND
    for told in ({}, {"pixel_size": PIXEL, "distance": BEHIND}):
        found = read(tmp_path / "s.nxs", told).exposures
        assert found.views.sources == pytest.approx([20 * max(SHAPE) * PIXEL] * 2)
        assert (found.views.pixel_size, found.distance[0]) == (PIXEL, BEHIND)
    far = read(tmp_path / "s.nxs", {"source_distance": 30 * max(SHAPE) * PIXEL, "pixel_size": PIXEL, "distance": 0.0})
    assert far.exposures.views.sources is None


def test_cones_of_rays_are_written_and_read_back(tmp_path: Path):
    views = replace(Views.evenly_spaced(3, shape=SHAPE, pixel_size=PIXEL), sources=np.array([1e-3, 2e-3, 1e-3]))
    scan = Scan(np.ones((3, *SHAPE)), Exposures.of(views, 20.0, 0.01), np.zeros(3))
    write_scan(tmp_path / "cones.nxs", scan)
    found = read(tmp_path / "cones.nxs").exposures
    assert np.array_equal(found.views.sources, views.sources)
    assert found.views.pixel_size == PIXEL
    assert found.distance.tolist() == [0.01] * 3
    parallel = replace(scan, exposures=Exposures.of(replace(views, sources=None), 20.0, 0.01))
    write_scan(tmp_path / "parallel.nxs", parallel)
    assert read(tmp_path / "parallel.nxs").exposures.views.sources is None
    views = join([tmp_path / "cones.nxs"] * 2, tmp_path / "joined.nxs").views
    assert np.array_equal(views.sources, [1e-3, 2e-3, 1e-3] * 2)
    with pytest.raises(InputError, match="must all have cones of rays or none, but 1 of 2 have them"):
        join([tmp_path / "cones.nxs", tmp_path / "parallel.nxs"], tmp_path / "both.nxs")


@pytest.mark.parametrize("name", ["scan.tif", "scene"])
def test_cones_of_rays_stand_in_tables(name, tmp_path: Path):
    views = replace(Views.evenly_spaced(3, shape=SHAPE, pixel_size=PIXEL), sources=np.array([1e-3, 2e-3, 1e-3]))
    scan = Scan(np.ones((3, *SHAPE), np.float32), Exposures.of(views, 20.0, 0.01), np.zeros(3, dtype=bool))
    (write_tiff if name == "scan.tif" else write_nerf_synthetic)(tmp_path / name, scan)
    assert np.array_equal(read(tmp_path / name).exposures.views.sources, views.sources)


def test_a_simulated_cone_is_that_of_its_source(tmp_path: Path):
    """A ball between source and axis is seen larger than on the axis, by R / (R + z)."""
    vertices, faces = icosphere(2)
    body = hs.mesh.TriangleMesh(1e-6 * (4 * vertices + np.array([0.0, 0.0, -50.0])), faces)
    write_mesh(tmp_path / "ball.vtk", body, "um")
    beam = ["--pixel-size", 2e-6, "--detector", 25, 31, "--angles-deg", 0, "--tilts-deg", 0, "--test-every", 0]
    cone = ["--source-distance", 0.2e-3, "--distance", 0.2e-3, "--cone", "--origin", 0, 0, 0]
    out = tmp_path / "cone.nxs"
    worked(holosplat("simulate", tmp_path / "ball.vtk", "--material", "gold", *beam, *cone, "--out", out))
    scan = read(out)
    assert scan.exposures.views.sources.tolist() == [0.2e-3]
    thickness, (y, x) = -np.log(scan.frames[0]), np.indices((25, 31))
    variance = float((thickness * ((y - 12) ** 2 + (x - 15) ** 2)).sum() / thickness.sum()) / 2
    assert np.sqrt(5 * variance) == pytest.approx(4 * 200 / 150, rel=0.03)  # a ball's chords have r² / 5


def test_what_needs_parallel_beams_refuses_cones(tmp_path: Path):
    views = replace(Views.evenly_spaced(3, shape=SHAPE, pixel_size=PIXEL), sources=np.full(3, 1e-3))
    scan = Scan(np.ones((3, *SHAPE)), Exposures.of(views, 20.0, 0.01), np.zeros(3))
    prior = hs.MaterialPrior.of_ratio(500.0)
    for call, what in (
        (lambda: hs.reconstruct(scan, prior, NeuralFields()), "the method neural-field"),
        (lambda: hs.align_views(scan, prior), "finding poses"),
        (lambda: find_axis(scan), "finding the rotation axis"),
    ):
        with pytest.raises(InputError, match=f"{what} needs parallel beams, but these diverge from a source 0.001 m"):
            call()


def test_what_a_file_of_cones_is_next_is_what_any_file_is(tmp_path: Path):
    views = replace(Views.evenly_spaced(3, shape=SHAPE, pixel_size=PIXEL), sources=np.full(3, 1e-3))
    scan = Scan(np.ones((3, *SHAPE)), Exposures.of(views, 20.0, 0.01), np.zeros(3))
    write_scan(tmp_path / "cones.nxs", scan)
    said = holosplat("info", tmp_path / "cones.nxs").out
    assert "0.001 m before the object, whose rays are a cone" in said
    assert f"holosplat reconstruct {tmp_path / 'cones.nxs'} --out run" in said
    assert "closed bodies" in said
