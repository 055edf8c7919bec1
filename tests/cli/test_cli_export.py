"""`holosplat export --compact` and OME-TIFF."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import h5py
import numpy as np
import tifffile

import holosplat as hs
from helpers.cli import holosplat, refused, worked
from holosplat.io.formats import read_volume_file
from holosplat.io.objects import read_object, read_series
from holosplat.io.ome import write_ome_tiff
from holosplat.io.volumes import read_volume, write_volume
from holosplat.optics.sampling import views_seeing


def test_a_run_is_exported_in_few_bytes_and_as_a_tiff(shop, tmp_path):
    done = worked(holosplat("export", shop.run, "--compact", tmp_path / "c.h5", "--volume", tmp_path / "v.ome.tif"))
    assert "times smaller than object.h5" in done.err
    assert read_object(tmp_path / "c.h5").described == read_object(shop.run / "object.h5").described
    with tifffile.TiffFile(tmp_path / "v.ome.tif") as file:
        assert file.series[0].axes == "CZYX"


def test_an_hdf5_volume_says_how_many_views_show_each_voxel(shop, tmp_path):
    run = shutil.copytree(shop.run, tmp_path / "run")
    worked(holosplat("export", run, "--volume", tmp_path / "v.h5", "--shape", 9, 8, 11))
    scan, volume = hs.read(shop.scan), read_volume(tmp_path / "v.h5")
    with h5py.File(tmp_path / "v.h5") as file:
        counted = file["views"]
        np.testing.assert_array_equal(counted, views_seeing(scan.train().exposures, volume.grid))
        assert counted.attrs["axes"] == "z, y, x"
    (run / "source.json").unlink()
    done = worked(holosplat("export", run, "--volume", tmp_path / "w.h5"))
    assert "w.h5 has no /views, for the run's scan cannot be read" in done.err
    assert "views" not in h5py.File(tmp_path / "w.h5")


def test_a_step_without_sense_leaves_nothing(shop, tmp_path):
    refused(holosplat("export", shop.run, "--compact", tmp_path / "c.h5", "--step-px", "7"), "step must")
    refused(holosplat("export", shop.run), "--volume, --bodies, --compact or --splats")
    assert not list(tmp_path.iterdir())


def test_a_run_is_exported_for_other_programs(shop, tmp_path):
    """Gaussians as splats, their volume as OME-Zarr; bodies need surfaces."""
    done = worked(
        holosplat(
            "export", shop.run, "--splats", tmp_path / "g.ply", "--volume", tmp_path / "v.ome.zarr", "--shape", 8, 9, 10
        )
    )
    assert "opacity stands for thickness" in done.err
    assert (tmp_path / "g.ply").read_bytes().startswith(b"ply\nformat binary_little_endian 1.0\ncomment holosplat: um")
    assert json.loads((tmp_path / "v.ome.zarr" / "0" / ".zarray").read_text())["shape"] == [2, 8, 9, 10]
    refused(holosplat("export", shop.run, "--volume", tmp_path / "v.ome.zarr"), "must be new or empty")
    refused(holosplat("export", shop.run, "--bodies", tmp_path / "b.glb"), "needs a run of surfaces")


def test_runs_of_a_series_share_a_compact_file(shop, tmp_path):
    second = shutil.copytree(shop.run, tmp_path / "second")
    done = worked(holosplat("export", shop.run, "--compact", tmp_path / "s.h5", "--together", second))
    assert "times smaller than 2 runs" in done.err
    assert list(read_series(tmp_path / "s.h5")) == ["run", "second"]
    refused(holosplat("export", shop.run, "--splats", tmp_path / "g.ply", "--together", second), "--together needs")


def test_a_volume_is_named_by_its_format_and_nothing_is_written_over(shop, tmp_path):
    for name in ("v", "v.npy", "v.raw"):
        refused(holosplat("export", shop.run, "--volume", tmp_path / name), "--volume", ".h5", ".vti", ".mrc", name)
    for option, name, known in (
        ("--compact", "c.nrrd", ".hdf5"),
        ("--splats", "g.vti", ".ply"),
        ("--bodies", "b.obj", ".vtu"),
    ):
        refused(
            holosplat("export", shop.run, option, tmp_path / name, "--volume", tmp_path / "v.h5"), option, known, name
        )
    assert not list(tmp_path.iterdir())
    (tmp_path / "v.beta.mrc").write_text("mine")
    refused(holosplat("export", shop.run, "--volume", tmp_path / "v.mrc"), "v.beta.mrc must be new, ", "--force")
    for option, name in (("--volume", "v.h5"), ("--volume", "v.tif"), ("--compact", "c.h5"), ("--splats", "g.ply")):
        (tmp_path / name).write_text("mine")
        refused(holosplat("export", shop.run, option, tmp_path / name), "must be new or empty")
        assert (tmp_path / name).read_text() == "mine"


def test_the_truth_may_be_an_exported_tiff_of_the_same_field(shop, tmp_path):
    truth, report = tmp_path / "truth.ome.tif", shop.run / "report.html"
    before, volume = report.read_bytes(), read_volume(shop.truth)
    write_ome_tiff(truth, volume)
    found = read_volume_file(truth)
    np.testing.assert_allclose(found.grid.origin, volume.grid.origin, rtol=1e-9)
    np.testing.assert_allclose(found.grid.voxel_size, volume.grid.voxel_size, rtol=1e-9)
    np.testing.assert_array_equal(found.delta, volume.delta.astype(np.float32))
    by_tiff, by_hdf5 = (worked(holosplat("evaluate", shop.run, "--truth", path)) for path in (truth, shop.truth))
    assert by_tiff.out == by_hdf5.out
    report.write_bytes(before)
    tifffile.imwrite(truth, volume.delta.astype(np.float32))
    refused(holosplat("evaluate", shop.run, "--truth", truth), "another TIFF file")
    grid = volume.grid
    for moved, words in (
        (replace(grid, origin=(grid.origin[0] + 1e-2, *grid.origin[1:])), "has no matter where the run has some"),
        (replace(grid, voxel_size=tuple(20 * size for size in grid.voxel_size)), "of this scan"),
    ):
        write_volume(tmp_path / "other.h5", replace(volume, grid=moved))
        refused(holosplat("evaluate", shop.run, "--truth", tmp_path / "other.h5"), words)
    assert report.read_bytes() == before
