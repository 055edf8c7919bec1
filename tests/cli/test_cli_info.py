"""`holosplat info`: every kind of path is described, all that is missing is said at once, and few frames are read."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile
import torch
from PIL import Image

from helpers.cli import copied, drop, holosplat, refused, truncated, worked
from helpers.two_balls import scan as two_balls
from holosplat.geometry import Grid
from holosplat.io.formats import FORMATS, write_volume_file
from holosplat.io.images import write_tiff
from holosplat.io.nxtomo import write_scan
from holosplat.io.phase_maps import PhaseMaps, write_phase_maps
from holosplat.io.raw_file import ScanFile
from holosplat.io.volumes import Contents
from holosplat.matter import DeltaBeta, Matter
from holosplat.representations import VoxelGrid

DETECTOR = "entry/instrument/detector"


def rows(*arguments: object) -> dict[str, list[str]]:
    """What info says, by the names of its rows."""
    found: dict[str, list[str]] = {}
    for line in worked(holosplat("info", *arguments)).out.splitlines():
        if line.startswith(" "):
            continue
        found.setdefault(line[:22].strip(), []).append(line[22:].strip())
    return found


def test_a_scan_is_described(shop):
    found = rows(shop.scan)
    assert found["frames"] == ["8 projections of 24 × 28 pixels (rows × columns), 2 held out of the fit"]
    assert found["photon energy"] == ["20 keV"]
    assert found["propagation distance"] == ["0.1 m"]
    assert found["pixel size"] == ["3.2 µm"]
    assert found["angles"] == ["0° to 157.5°; frame 0 at 0°, frame 7 at 157.5°"]
    assert found["steps"] == ["22.5°, no gaps"]
    assert found["axis"][0].startswith("column 13.5 of 28")
    assert "0.78 pixels" in found["fringes"][0]
    assert re.fullmatch(r"none is seen beyond .* % of the level, .* % of the contrast", found["noise"][0])
    assert "of memory" in found["closed bodies"][0]
    assert "of memory" in found["continuous matter"][0]
    assert "missing" not in found
    assert found["next"] == [f"holosplat reconstruct {shop.scan} --out run"]


def test_what_is_no_scan_is_described_before_torch_would_be_imported(shop, tmp_path):
    """PyTorch takes longer to import than all else; SciPy a third of a second."""
    (tmp_path / "notes.md").write_text("nothing")
    program = "import sys; from holosplat.report.info import info\nfor path in sys.argv[1:]: info(path)\n"
    program += "print(*{'torch', 'scipy', 'matplotlib'}.intersection(sys.modules))"
    paths = map(str, (shop.truth, shop.run, tmp_path / "notes.md"))
    done = subprocess.run([sys.executable, "-c", program, *paths], check=True, capture_output=True, text=True)
    assert done.stdout.split() == []


def test_all_that_is_missing_is_said_at_once_with_its_options(shop, tmp_path):
    """Two readers' sentences, of which the first alone would end another command."""

    def bare(file: h5py.File) -> None:
        for name in ("beam/incident_energy", "detector/distance", "detector/x_pixel_size", "detector/y_pixel_size"):
            drop(f"entry/instrument/{name}")(file)
        for name in ("entry/sample/view_rotation", "entry/sample/rotation_angle", "entry/data/rotation_angle"):
            drop(name)(file)

    path = copied(shop.scan, tmp_path, bare)
    found = rows(path)
    said = " ".join(found["missing"])
    assert all(option in said for option in ("--energy-kev", "--distance", "--pixel-size", "--angles"))
    assert found["photon energy"] == found["angles"] == ["not known"]
    assert "fringes" not in found
    assert "closed bodies" not in found
    assert "--pixel-size …" in found["next"][0]
    assert "--angles …" in found["next"][0]
    assert holosplat("info", path).err == ""  # nothing is said of values that stand in
    angles = tmp_path / "angles.txt"
    angles.write_text("\n".join(str(22.5 * n) for n in range(8)))
    told = rows(path, "--energy-kev", 20, "--distance", 0.1, "--pixel-size", 3.2e-6, "--angles", angles)
    assert "missing" not in told
    assert told["fringes"] == rows(shop.scan)["fringes"]


def test_one_missing_field_hides_no_other(shop, tmp_path):
    """NXtomo names one missing dataset by itself; info goes on behind it."""

    def bare(file: h5py.File) -> None:
        for name in ("instrument/beam/incident_energy", "sample/view_rotation", "sample/rotation_angle"):
            drop(f"entry/{name}")(file)
        drop("entry/data/rotation_angle")(file)

    said = rows(copied(shop.scan, tmp_path, bare))["missing"]
    assert len(said) == 2
    assert "--angles" in said[0] + said[1]
    assert "--energy-kev" in said[0] + said[1]


@pytest.mark.parametrize("kind", ["nerf-synthetic", "r2-gaussian"])
def test_folders_of_other_programs_say_what_they_lack(shop, tmp_path, kind):
    folder = tmp_path / "folder"
    more = ["--delta-beta", 1000] if kind == "r2-gaussian" else []
    worked(holosplat("convert", shop.scan, "--to", kind, folder, *more))
    for path in folder.glob("*.json"):
        table = json.loads(path.read_text())
        table.pop("holosplat", None)
        path.write_text(json.dumps(table))
    said = " ".join(rows(folder)["missing"])
    assert "--energy-kev" in said
    assert "--pixel-size" in said


def test_gaps_and_noise_and_counts_are_seen(tmp_path):
    scan = two_balls(200, 20)
    kept = scan[np.r_[0:8, 12:20]]
    write_scan(tmp_path / "gap.nxs", kept)
    found = rows(tmp_path / "gap.nxs")
    assert found["steps"] == ["9°, 1 gap: 63° to 108°"]
    noise = float(found["noise"][0].split(" %")[0])
    assert noise == pytest.approx(100 / np.sqrt(200), rel=0.4)
    counts = tmp_path / "counts.npz"
    angles = np.linspace(0, 180, len(kept), endpoint=False)
    beam = {"energy_kev": 15.0, "distance": 0.12, "pixel_size": 1e-6}
    np.savez(counts, counts=(900 * kept.frames).astype(np.uint16), angles_deg=angles, **beam)
    assert "divide counts by their flats" in rows(counts)["missing"][0]
    np.savez(counts, counts=kept.frames / 900, angles_deg=angles, **beam)
    assert "none for frames that were divided before" in rows(counts)["missing"][0]
    flats = np.full((2, *kept.views.shape), 900, np.uint16)
    np.savez(counts, counts=(900 * kept.frames).astype(np.uint16), flats=flats, angles_deg=angles, **beam)
    assert "missing" not in rows(counts)
    assert "16 projections of 25 × 28 pixels (rows × columns), 2 flats" in rows(counts)["frames"]


def test_values_of_other_files_are_read_where_that_is_allowed(shop, tmp_path):
    shutil.copy(shop.scan, tmp_path / "other.h5")
    with h5py.File(shutil.copy(shop.scan, tmp_path / "scan.nxs"), "a") as file:
        del file["entry/data/data"]
        file["entry/data/data"] = h5py.ExternalLink("other.h5", "/entry/data/data")
    refused(holosplat("info", tmp_path / "scan.nxs"), "add --allow-external")
    worked(holosplat("info", tmp_path / "scan.nxs", "--allow-external"))


def test_the_air_is_found(tmp_path):
    scan = two_balls(2000)
    wide = np.pad(scan.frames, ((0, 0), (12, 12), (12, 12)), constant_values=1.0)
    beam = {"energy_kev": 15.0, "distance": 0.12, "pixel_size": 1e-6, "angles_deg": np.arange(6) * 30.0}
    np.savez(tmp_path / "air.npz", counts=1.25 * wide, **beam)
    level = float(rows(tmp_path / "air.npz")["air level"][0].split()[0])
    assert level == pytest.approx(1.25, abs=0.02)


def test_the_next_command_repeats_what_was_said(shop, tmp_path):
    path = copied(shop.scan, tmp_path, drop("entry/instrument/detector/distance"))
    command = rows(path, "--distance", 0.2, "--views", "0:8:2")["next"]
    assert command == [f"holosplat reconstruct {path} --distance 0.2 --views 0:8:2 --out run"]


@pytest.mark.parametrize("level", [0.0, -1.0])
def test_slices_of_a_volume_are_no_frames(tmp_path, level):
    """Most of a volume is empty: its values have no level to be measured by."""
    values = np.full((4, 32, 32), level, np.float32)
    values[:, 8:14, 8:14] = 4e-8
    tifffile.imwrite(tmp_path / "slices.tif", values, photometric="minisblack")
    found = rows(tmp_path / "slices.tif")
    assert found["values"] == [f"{level:g} to 4e-08, which are no intensities"]
    assert found.keys().isdisjoint({"noise", "contrast", "fringes", "next"})
    assert any("must hold intensities" in each and "--voxel-size" in each for each in found["missing"])


@pytest.mark.parametrize("suffix", FORMATS)
def test_volumes_of_mu_say_so(tmp_path, suffix):
    grid = Grid.centred((5, 6, 7), 2e-6)
    obj = VoxelGrid(torch.ones(1, *grid.shape), grid, Matter((DeltaBeta(4e-7, 2e-10),)))
    of = Contents.of(False, 20.0)
    write_volume_file(tmp_path / f"v{suffix}", obj, grid, of=of)
    found = rows(tmp_path / f"v{suffix}")
    assert found["what"][0].startswith("a volume of µ and β")
    assert "5 × 6 × 7" in found["shape"][0]
    mu = float(obj.matter.beta * of.mu_per_beta)
    if suffix in (".vti", ".nrrd", ".mrc", ".h5", ".hdf5"):
        assert found["µ"][0].startswith(f"{mu:.3g} to {mu:.3g} m⁻¹")


def test_the_picture_shows_frames_and_spectrum(shop, tmp_path):
    picture = tmp_path / "look.png"
    worked(holosplat("info", shop.scan, "--picture", picture))
    image = np.asarray(Image.open(picture).convert("RGB")).astype(int)
    reddish = (image[..., 0] > image[..., 2] + 100).sum()
    assert reddish > 100  # the curve of the spectrum
    greys = image[(image == image[..., :1]).all(axis=2)]
    assert len(np.unique(greys)) > 100  # frames and their bar
    refused(holosplat("info", shop.scan, "--picture", tmp_path / "look.jpg"), "--picture must be a .png file")
    refused(holosplat("info", shop.truth, "--picture", tmp_path / "none.png"), "--picture is of the frames of a scan")
    assert not (tmp_path / "none.png").exists()


def test_a_run_says_what_it_is_and_what_comes_next(shop, tmp_path):
    found = rows(shop.run)
    assert found["made from"] == [str(shop.scan)]
    assert found["state"] == ["finished"]
    assert found["verdict"]
    assert found["time"]
    assert found["total"]
    assert any("holosplat export" in each for each in found["next"])
    assert not any("--resume" in each for each in found["next"])
    begun = tmp_path / "begun"
    begun.mkdir()
    for name in ("config.json", "source.json"):
        shutil.copy(shop.run / name, begun)
    cut_off = rows(begun)
    assert cut_off["state"] == ["begun; no result yet"]
    assert "--resume" in cut_off["next"][0]
    assert len(cut_off["next"]) == 1


def test_volumes_objects_meshes_and_what_is_none_of_these(shop, tmp_path):
    assert rows(shop.truth)["what"] == ["a volume of δ and β (HDF5)"]
    assert "28 × 24 × 28 voxels" in rows(shop.truth)["shape"][0]
    tiff = tmp_path / "truth.ome.tif"
    worked(holosplat("export", shop.run, "--volume", tiff))
    assert rows(tiff)["what"] == ["a volume of δ and β (OME-TIFF)"]
    assert rows(shop.run / "object.h5")["what"] == ["an object (holosplat object 1): GaussianCloud"]
    scan, maps = two_balls(), tmp_path / "maps.h5"
    write_phase_maps(maps, PhaseMaps({"phase": scan.frames}, scan.exposures))
    assert rows(maps)["what"] == ["holosplat phase maps 1"]
    mesh = rows(shop.cells[0])
    assert "triangles" in mesh["shape"][0]
    assert "--length-unit" in mesh["missing"][0]
    other = tmp_path / "notes.md"
    other.write_text("nothing")
    assert rows(other)["what"] == ["nothing that can be read as it stands"]
    assert "none of what is known" in rows(other)["problem"][0]
    refused(holosplat("info", tmp_path / "none"), "there is nothing; check the path")
    refused(holosplat("info", truncated(shop.scan, tmp_path)), "truncated")


def test_a_tiff_folder_is_a_scan(shop, tmp_path):
    write_tiff(tmp_path / "tiff", two_balls())
    assert "6 projections" in rows(tmp_path / "tiff")["frames"][0]


def test_few_frames_of_a_large_stack_are_read(tmp_path, monkeypatch):
    """A sparse file of 1000 frames of 2048² pixels, 100 flats and darks: 3 frames, 3 flats and 3 darks are read."""
    path = tmp_path / "large.nxs"
    large(path, 1100)
    taken = set[int]()
    read = ScanFile.frame
    monkeypatch.setattr(ScanFile, "frame", lambda self, number: taken.add(int(number)) or read(self, number))
    found = rows(path, "--energy-kev", 20, "--distance", 0.1, "--pixel-size", 1e-6)
    assert found["frames"] == ["1000 projections of 2048 × 2048 pixels (rows × columns), 50 flats, 50 darks"]
    assert taken == {0, 24, 49, 50, 74, 99, 100, 600, 1099}
    assert "are free" in found["closed bodies"][0]


def large(path: Path, count: int) -> None:
    """A stack of which few frames are on the disk."""
    kinds, frames = np.zeros(count, int), h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    kinds[:50], kinds[50:100] = 1, 2
    frames.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
    frames.set_fill_time(h5py.h5d.FILL_TIME_NEVER)
    with h5py.File(path, "w") as file:
        detector, sample = file.create_group(DETECTOR), file.create_group("entry/sample")
        space = h5py.h5s.create_simple((count, 2048, 2048))
        h5py.h5d.create(detector.id, b"data", h5py.h5t.NATIVE_UINT16, space, frames)
        detector["image_key"] = kinds
        sample["rotation_angle"] = np.linspace(0, 180, count)
        sample["rotation_angle"].attrs["units"] = "deg"
        detector["data"][0:50:24] = 1000
        detector["data"][49] = 1000
        for number in (100, 599, 600, 1099):
            detector["data"][number] = 990 + np.arange(2048) % 20
