"""`holosplat export --compact` and OME-TIFF."""

from __future__ import annotations

import json
import shutil

import tifffile

from helpers.cli import holosplat, refused, worked
from holosplat.io.objects import read_object
from holosplat.io.series import read_series


def test_a_run_is_exported_in_few_bytes_and_as_a_tiff(shop, tmp_path):
    done = worked(holosplat("export", shop.run, "--compact", tmp_path / "c.h5", "--volume", tmp_path / "v.ome.tif"))
    assert "times smaller than object.h5" in done.err
    assert read_object(tmp_path / "c.h5").described == read_object(shop.run / "object.h5").described
    with tifffile.TiffFile(tmp_path / "v.ome.tif") as file:
        assert file.series[0].axes == "CZYX"


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
