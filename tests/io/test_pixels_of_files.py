"""Files of frames whose pixel sizes differ."""

from __future__ import annotations

import h5py
import numpy as np
import pytest

from holosplat.checks import InputError
from holosplat.geometry import Views, rotation_y
from holosplat.io.beams import Beams, read_beams, write_beams
from holosplat.io.images import read_tiff, write_tiff
from holosplat.io.nxtomo import read_scan, write_scan
from holosplat.io.phase_maps import PhaseMaps, write_phase_maps
from holosplat.scan import Exposures, Scan
from holosplat.workflows.provenance import scan_hash
from holosplat_bench.formats.nerf_synthetic import write_nerf_synthetic
from holosplat_bench.formats.r2_gaussian import write_r2_gaussian

SIZES, SHAPE = 3.2e-6 * np.array([1.0, 1.5, 0.7]), (4, 5)


def mixed(sizes: np.ndarray = SIZES) -> Scan:
    views = Views.of_pixels(rotation_y([0, 40, 90]), np.full((3, 2), 1e-6), SHAPE, sizes)
    frames = np.arange(60, dtype=np.float32).reshape(3, *SHAPE)
    return Scan(frames, Exposures.of(views, 20.0, 0.1), np.array([False, True, False]))


@pytest.mark.parametrize("kind", ["nxtomo", "tiff"])
def test_a_pixel_size_for_each_frame_comes_back(kind, tmp_path):
    write, read = {"nxtomo": (write_scan, read_scan), "tiff": (write_tiff, read_tiff)}[kind]
    write(tmp_path / "scan", mixed())
    found = read(tmp_path / "scan")
    np.testing.assert_allclose(found.views.pixel_sizes, SIZES, rtol=1e-15)
    assert found.views.pitch == SIZES.min()
    np.testing.assert_array_equal(found.frames, mixed().frames)


def test_nexus_and_hashes_know_them(tmp_path):
    write_scan(tmp_path / "scan.h5", mixed())
    with h5py.File(tmp_path / "scan.h5") as file:
        np.testing.assert_array_equal(file["/entry/instrument/detector/y_pixel_size"][()], mixed().views.pixel_sizes)
    hashes = {scan_hash(mixed(sizes)) for sizes in (SIZES, SIZES[::-1], SIZES[:1] * np.ones(3))}
    assert len(hashes) == 3


def test_geometry_has_the_pixels_of_each_view(tmp_path):
    write_beams(tmp_path / "geometry.toml", Beams.of(mixed().exposures))
    found = read_beams(tmp_path / "geometry.toml").applied(mixed(SIZES[:1] * np.ones(3)))
    np.testing.assert_allclose(found.views.pixel_sizes, SIZES, rtol=1e-15)


def test_phase_maps_say_them(tmp_path):
    maps = PhaseMaps({"phase": mixed().frames}, mixed().exposures)
    write_phase_maps(tmp_path / "maps.h5", maps)
    with h5py.File(tmp_path / "maps.h5") as file:
        np.testing.assert_allclose(file["pixel_size"][()], SIZES, rtol=1e-15)


def test_formats_of_one_raster_refuse_them(tmp_path):
    with pytest.raises(InputError):
        write_r2_gaussian(tmp_path / "r2", mixed(), np.ones((3, *SHAPE)), 1.0)
    with pytest.raises(InputError, match=r"one pixel size, but theirs go from 2\.24 to 4\.8 µm"):
        write_nerf_synthetic(tmp_path / "nerf", mixed())
    assert list(tmp_path.iterdir()) == []
