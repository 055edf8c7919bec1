"""`holosplat retrieve`: phase maps of a scan in files."""

from __future__ import annotations

import json

import h5py
import numpy as np
import pytest
import tifffile
from PIL import Image

import holosplat as hs
from helpers.cli import FORMULA, PIXEL, holosplat, refused, worked
from holosplat.io.nxtomo import read_scan, write_scan

MATTER = ("--material", FORMULA, "--density", "1.335")


def test_a_folder_holds_maps_with_their_units_and_a_picture(shop, tmp_path):
    out = tmp_path / "maps"
    done = worked(holosplat("retrieve", shop.scan, *MATTER, "--views", "0:8:2", "--crop", ":,2:27", "--out", out))
    assert "rad" in done.out
    table = json.loads((out / "maps.json").read_text())
    assert {name: entry["unit"] for name, entry in table["maps"].items()} == {"phase": "rad", "thickness": "m"}
    assert table["pixel_size_m"] == PIXEL
    assert len(table["frames"]) == 4
    assert table["facts"]["light"] == "even"
    scan = read_scan(shop.scan)[[0, 2, 4, 6]].cropped(slice(0, 24), slice(2, 27))
    material = hs.materials.parse_material(FORMULA, 1.335).delta_beta(20.0)
    wanted = hs.retrieve(scan.frames, scan.exposures, material)
    np.testing.assert_array_equal(tifffile.imread(out / "phase.tif"), wanted.phase.numpy())
    np.testing.assert_array_equal(tifffile.imread(out / "thickness.tif"), wanted.thickness.numpy())
    with tifffile.TiffFile(out / "phase.tif") as file:
        assert file.pages[0].description == "phase, rad"  # pyright: ignore[reportAttributeAccessIssue]
    with Image.open(out / "preview.png") as picture:
        assert np.asarray(picture).std() > 10


def test_an_hdf5_file_holds_the_same_with_units(shop, tmp_path):
    """With δ/β alone there is a phase, and no thickness."""
    out = tmp_path / "maps.h5"
    done = worked(
        holosplat("retrieve", shop.scan, "--delta-beta", "2000", "--method", "paganin", "--views", "1", "--out", out)
    )
    assert "no thickness" in done.err
    with h5py.File(out) as file:
        assert "thickness" not in file
        assert file["phase"].shape == (1, 24, 28)
        assert file["phase"].attrs["units"] == "rad"
        assert file["pixel_size"][()] == PIXEL
        assert file.attrs["method"] == "paganin"
        phase = file["phase"][()]
    scan = read_scan(shop.scan)[[1]]
    wanted = hs.retrieve(scan.frames, scan.exposures, hs.DeltaBeta(1e-7, 5e-11), "paganin").phase
    np.testing.assert_allclose(phase, wanted.numpy(), rtol=1e-3, atol=1e-4)


def test_uneven_light_is_found_said_and_written(tmp_path):
    """Slopes of 3 % in frames of a small body, by the options of light, too."""
    x = np.linspace(-1, 1, 80)
    clean = 1 + 0.1 * np.exp(-((x / 0.1) ** 2) - (x[:60, None] / 0.1 + 2) ** 2)
    noise = np.random.default_rng(0).normal(scale=0.003, size=clean.shape)
    frame = (clean * (1 + 0.03 * x) + noise)[None].astype(np.float32)
    exposures = hs.Exposures.of(hs.Views.from_angles([0.0], (60, 80), 1e-6), 20.0, 0.05)
    write_scan(tmp_path / "scan.nxs", hs.Scan(frame, exposures, np.array([False])))
    said = ("retrieve", tmp_path / "scan.nxs", "--delta-beta", "500", "--method", "paganin")
    done = worked(holosplat(*said, "--out", tmp_path / "maps"))
    assert "light uneven by 1." in done.out
    light = tifffile.imread(tmp_path / "maps/light.tif").squeeze()
    np.testing.assert_allclose(light[:, [2, -3]].mean(0), 1 + 0.03 * x[[2, -3]], atol=0.003)
    worked(holosplat(*said, "--out", tmp_path / "even.h5", "--light", "even"))
    with h5py.File(tmp_path / "even.h5") as file:
        assert "light" not in file
    boxes = ("--light", "smooth", "--air", "0", "60", "0", "30", "0", "60", "50", "80")
    worked(holosplat(*said, "--out", tmp_path / "boxes.h5", *boxes))
    with h5py.File(tmp_path / "boxes.h5") as file:
        np.testing.assert_allclose(file["light"][0][:, [2, -3]].mean(0), 1 + 0.03 * x[[2, -3]], atol=0.003)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ((), ("--material or --delta-beta",)),
        (("--material", FORMULA), ("density",)),
        ((*MATTER, "--delta-beta", "100"), ("not both",)),
        ((*MATTER, "--views", "99"), ("--views", "99")),
        ((*MATTER, "--bin", "25"), ("binned by 1 to 24, but not by 25",)),
        ((*MATTER, "--air", "0", "99", "0", "5"), ("--air", "24 rows")),
        ((*MATTER, "--light", "smooth"), ("no frame shows air", "--light even")),
    ],
)
def test_bad_requests_are_refused_before_anything_is_written(shop, tmp_path, options, words):
    refused(holosplat("retrieve", shop.scan, *options, "--out", tmp_path / "out"), *words)
    assert not any(tmp_path.iterdir())


def test_nothing_is_overwritten(shop, tmp_path):
    for name in ("maps.h5", "maps"):
        out = tmp_path / name
        out.mkdir() if name == "maps" else out.write_text("mine")
        if out.is_dir():
            (out / "mine").write_text("mine")
        refused(holosplat("retrieve", shop.scan, *MATTER, "--out", out), name)
    refused(holosplat("retrieve", shop.scan, *MATTER, "--out", tmp_path / "nowhere/maps.h5"), "nowhere")


def test_counts_are_refused(shop, tmp_path):
    """Their logarithm would be a phase of nothing."""
    scan = read_scan(shop.scan)
    write_scan(tmp_path / "counts.nxs", hs.Scan(3000 * scan.frames[:], scan.exposures, scan.is_test))
    for act in ("retrieve", "align"):
        refused(holosplat(act, tmp_path / "counts.nxs", *MATTER, "--out", tmp_path / "out.nxs"), "--flats", "level")
    counted = read_scan(tmp_path / "counts.nxs")
    with pytest.raises(hs.InputError, match=r"relative to the flat field.*level"):
        hs.retrieve(counted.frames, counted.exposures, hs.DeltaBeta(5.8e-7, 2.6e-10))
    for out in ("out.nxs", "images"):
        to = () if out.endswith("nxs") else ("--to", "tiff")
        refused(holosplat("convert", tmp_path / "counts.nxs", tmp_path / out, *to), "--flats", "level")
    assert sorted(one.name for one in tmp_path.iterdir()) == ["counts.nxs"]
