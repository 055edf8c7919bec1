"""Files of other beamlines and programs, each made here after its documented layout, and what they leave out."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import tifffile
from PIL import Image

from holosplat.checks import InputError
from holosplat.geometry import rotation_y
from holosplat.io.formats import loader_of, open_raw, read
from holosplat.io.images import write_tiff
from holosplat.io.raw_file import DARK, FLAT, PROJECTION
from holosplat.io.reading import Reading, Told
from holosplat.scan import Scan
from holosplat.workflows.correct import CorrectionOptions, correct

N, H, W = 5, 7, 10
ANGLES = 33.0 * np.arange(N)
CLEAN = 0.6 + 0.4 * np.random.default_rng(0).random((N, H, W))
LIGHT = 900 + 200 * np.random.default_rng(1).random((H, W))
BLACK = 40 + np.arange(W, dtype=float) * np.ones((H, 1))
COUNTS, FLATS, DARKS = CLEAN * LIGHT + BLACK, np.stack([LIGHT + BLACK] * 3), np.stack([BLACK] * 2)
SAID = {"energy_kev": 20.0, "distance": 0.3, "pixel_size": 2e-6}


def put(group: h5py.Group, fields: dict[str, Any]) -> None:
    """Datasets by path; a pair is a value and its unit."""
    for name, value in fields.items():
        value, unit = value if isinstance(value, tuple) else (value, None)
        group[name] = value
        if unit:
            group[name].attrs["units"] = unit


def nx_class(group: h5py.Group, name: str, kind: str) -> h5py.Group:
    made = group.create_group(name)
    made.attrs["NX_class"] = kind
    return made


def diamond(path: Path) -> Path:
    """As Diamond's data acquisition writes it: a subentry; links in /entry1/tomo_entry/data; no beam, no distance."""
    with h5py.File(path, "w") as file:
        tomo = nx_class(nx_class(file, "entry1", "NXentry"), "tomo_entry", "NXsubentry")
        frames = np.concatenate([DARKS, FLATS, COUNTS])
        key = [2] * 2 + [1] * 3 + [0] * N
        put(tomo, {"definition": "NXtomo", "instrument/detector/data": frames, "instrument/detector/image_key": key})
        put(tomo, {"sample/rotation_angle": (np.r_[np.zeros(5), ANGLES], "degrees"), "control/data": np.ones(N + 5)})
        for name, target in (("data", "instrument/detector/data"), ("rotation_angle", "sample/rotation_angle")):
            tomo[f"data/{name}"] = h5py.SoftLink(f"/entry1/tomo_entry/{target}")
    return path


def esrf(path: Path, entry: str = "entry0000", **more: Any) -> Path:
    """As nxtomomill writes it: units in the SI and others, image_key_control with alignment frames (-1)."""
    with h5py.File(path, "a") as file:
        group = nx_class(file, entry, "NXentry")
        frames = np.concatenate([DARKS, FLATS, COUNTS, COUNTS[:1] + 7])
        control = np.array([2] * 2 + [1] * 3 + [0] * N + [-1])
        put(group, {"definition": "NXtomo", "instrument/detector/data": frames})
        put(group, {"instrument/detector/image_key_control": control})
        put(group, {"instrument/detector/image_key": np.where(control < 0, 0, control)})
        put(group, {"sample/rotation_angle": (np.r_[np.zeros(5), ANGLES, 0.0], "deg")})
        fields = {
            "instrument/beam/incident_energy": (20.0 * 1.602176634e-16, "J"),
            "instrument/detector/x_pixel_size": (6.5, "µm"),
            "instrument/detector/y_pixel_size": (6.5, "µm"),
            "sample/x_pixel_size": (2e-6, "m"),
            "sample/y_pixel_size": (2e-3, "millimeter"),
            "instrument/detector/distance": (1.2, "m"),
            "sample/propagation_distance": (300.0, "mm"),
            **more,
        }
        put(group, {name: value for name, value in fields.items() if value is not None})
    return path


def exchange(path: Path, **more: Any) -> Path:
    """As the Advanced Photon Source writes it."""
    with h5py.File(path, "w") as file:
        put(file, {"implements": "exchange", "exchange/data": COUNTS, "exchange/theta": (ANGLES, "deg")})
        put(file, {"exchange/data_white": FLATS, "exchange/data_dark": DARKS, **more})
    return path


def archive(path: Path) -> Path:
    np.savez(path, counts=COUNTS, flat=FLATS[0], dark=DARKS[0], angles_deg=ANGLES, provenance="a camera")
    return path


def plain_hdf5(path: Path) -> Path:
    with h5py.File(path, "w") as file:
        put(file, {"projections": COUNTS, "flats": FLATS, "darks": DARKS, "angles": ANGLES, "distance": 0.3})
    return path


def tiff_folder(path: Path) -> Path:
    path.mkdir()
    for n, frame in enumerate(COUNTS):
        tifffile.imwrite(path / f"raw_{n + 8}.tif", frame)
    for name, frames in (("flat", FLATS), ("dark", DARKS)):
        for n, frame in enumerate(frames):
            tifffile.imwrite(path / f"{name}_{n}.tif", frame)
    return path


MADE = {
    "tomo.nxs": (diamond, "nxtomo", SAID),
    "esrf.nx": (esrf, "nxtomo", {}),
    "aps.h5": (exchange, "data-exchange", SAID),
    "counts.npz": (archive, "arrays", SAID),
    "plain.h5": (plain_hdf5, "arrays", {"energy_kev": 20.0, "pixel_size": 2e-6}),
    "folder": (tiff_folder, "images", {**SAID, "angles_deg": ANGLES}),
}


def right(scan: Scan) -> None:
    np.testing.assert_allclose(scan.frames, CLEAN, atol=1e-6)
    np.testing.assert_allclose(scan.views.rotations, rotation_y(ANGLES), atol=1e-12)
    assert scan.exposures.one_energy("it") == pytest.approx(20)
    assert scan.views.pixel_size == pytest.approx(2e-6)
    np.testing.assert_allclose(scan.exposures.distance, 0.3)


@pytest.mark.parametrize("name", MADE)
def test_a_file_of_another_program_is_read_and_corrected(tmp_path, name):
    make, kind, said = MADE[name]
    path = make(tmp_path / name)
    assert loader_of(path).name == kind
    right(read(path, said))
    np.testing.assert_allclose(pickle.loads(pickle.dumps(read(path, said)[[1, 3]])).frames, CLEAN[[1, 3]], atol=1e-6)
    with open_raw(path, said) as file:
        assert len(file.numbers(PROJECTION)) == N
        np.testing.assert_allclose(file.mean(FLAT), LIGHT + BLACK)
        np.testing.assert_allclose(file.mean(DARK), BLACK)


@pytest.mark.parametrize("name", ["tomo.nxs", "aps.h5", "counts.npz", "folder"])
@pytest.mark.parametrize("missing", list(SAID))
def test_what_is_not_said_is_asked_for_by_its_option(tmp_path, name, missing):
    make, _, said = MADE[name]
    path = make(tmp_path / name)
    option = f"--{missing.replace('_', '-')}"
    with pytest.raises(InputError, match=rf"say it by {option}"):
        read(path, {key: value for key, value in said.items() if key != missing})
    with pytest.raises(InputError, match=rf"{option} must"):
        read(path, said | {missing: -1.0})


@pytest.mark.parametrize("name", ["tomo.nxs", "aps.h5", "counts.npz", "folder"])
def test_all_that_is_missing_is_named_at_once(tmp_path, name):
    path = MADE[name][0](tmp_path / name)
    with pytest.raises(InputError, match="say them by --energy-kev, --distance and --pixel-size"):
        read(path, {})
    with pytest.raises(InputError, match="the photon energy and pixel size; say them by --energy-kev and --pixel-size"):
        read(path, {"distance": 0.0})


def test_raw_frames_of_another_program_are_corrected_by_the_command(tmp_path):
    raw = archive(tmp_path / "a.npz")
    correct(raw, tmp_path / "scan.nxs", CorrectionOptions("plain"), reading=Reading(Told(**SAID)))
    right(read(tmp_path / "scan.nxs"))


def test_several_scans_in_a_file_are_told_apart_by_their_entry(tmp_path):
    path = esrf(esrf(tmp_path / "two.nx"), "entry0001", **{"sample/propagation_distance": (0.5, "m")})
    with pytest.raises(InputError, match="choose one by --entry: entry0000, entry0001"):
        read(path)
    right(read(path, {"entry": "entry0000"}))
    assert set(read(path, {"entry": "entry0001"}).exposures.distance) == {0.5}
    with pytest.raises(InputError, match="has no group entry7; --entry must be one of entry0000, entry0001"):
        read(path, {"entry": "entry7"})


def test_pixels_in_the_plane_of_the_sample_come_first(tmp_path):
    detector = esrf(tmp_path / "a.nx", **{"sample/x_pixel_size": None, "sample/y_pixel_size": None})
    assert read(detector).views.pixel_size == pytest.approx(6.5e-6)
    more = {"sample/x_pixel_size": None, "sample/y_pixel_size": None}
    more |= {f"instrument/detector/{axis}_magnified_pixel_size": (2.0, "um") for axis in "xy"}
    right(read(esrf(tmp_path / "b.nx", **more)))


def test_a_missing_pixel_size_along_x_is_not_taken_from_y(tmp_path):
    path = esrf(tmp_path / "a.nx", **{"sample/x_pixel_size": None})
    with pytest.raises(InputError, match=r"x_pixel_size must be there beside y_pixel_size \(2e-06 m\).*--pixel-size"):
        read(path)
    right(read(path, {"pixel_size": 2e-6}))


def test_exchange_says_what_stands_in_measurement(tmp_path):
    inner = "measurement/instrument/"
    path = exchange(
        tmp_path / "a.h5",
        **{
            inner + "monochromator/energy": (20.0, "keV"),
            inner + "detection_system/objective/resolution": (2.0, "micron"),
            inner + "detector_motor_stack/setup/camera_distance": (300.0, "mm"),
        },
    )
    right(read(path))
    with h5py.File(path, "r+") as file:
        del file["exchange/theta"], file[inner + "detection_system/objective/resolution"].attrs["units"]
        put(file, {"exchange/theta": (np.deg2rad(ANGLES), "rad")})
    with pytest.raises(InputError, match="--pixel-size"):
        read(path)
    right(read(path, {"pixel_size": 2e-6}))


@pytest.mark.parametrize(
    ("name", "change", "said"),
    [
        ("exchange/theta", None, "does not say the frames' angles; name a text file of them by --angles FILE"),
        (
            "exchange/theta",
            np.zeros(N - 1),
            "each of the 5 projections .flats and darks have none., but there are 4",
        ),
        ("exchange/data_white", np.ones((2, H, W + 1)), r"flats and darks must have the frames' \(7, 10\) pixels"),
        ("exchange/data_white", np.ones((2, 3, H, W)), r"frames must have the shape \[N, H, W\]"),
        ("exchange/data_white", None, r"must mark flats \(1\) beside the dark ones"),
        ("exchange/data_dark", FLATS, "must have darks that are alike and no flats"),
    ],
)
def test_a_broken_exchange_file_is_named(tmp_path, name, change, said):
    path = exchange(tmp_path / "a.h5")
    with h5py.File(path, "r+") as file:
        del file[name]
        if change is not None:
            file[name] = change
    with pytest.raises(InputError, match=said):
        read(path, SAID)


def test_one_image_needs_no_angle_and_pages_are_frames(tmp_path):
    tifffile.imwrite(tmp_path / "one.tif", CLEAN[0].astype(np.float32))
    one = read(tmp_path / "one.tif", SAID)
    np.testing.assert_allclose(one.frames, CLEAN[:1], atol=1e-6)
    np.testing.assert_allclose(one.views.rotations, rotation_y([0.0]))
    tifffile.imwrite(tmp_path / "stack.tiff", CLEAN.astype(np.float32), photometric="minisblack")
    right(read(tmp_path / "stack.tiff", {**SAID, "angles_deg": ANGLES}))
    with pytest.raises(InputError, match="--angles FILE"):
        read(tmp_path / "stack.tiff", SAID)


def test_flats_and_darks_are_named_beside_the_frames(tmp_path):
    folder = tmp_path / "frames"
    folder.mkdir()
    for n, frame in enumerate(COUNTS):
        Image.fromarray(np.round(frame).astype(np.uint16)).save(folder / f"p{n}.png")
        Image.fromarray(np.round(frame).astype(np.uint16)).save(folder / f"other{n}.png")
    np.save(tmp_path / "flats.npy", FLATS)
    tifffile.imwrite(tmp_path / "dark.tif", DARKS[0])
    beside = {"flats": tmp_path / "flats.npy", "darks": tmp_path / "dark.tif", "angles_deg": ANGLES}
    found = read(folder, {**SAID, **beside, "files": "p*.png"})
    np.testing.assert_allclose(found.frames, CLEAN, atol=1e-3)
    with pytest.raises(InputError, match=r"must hold projections .* named q"):
        read(folder, {**SAID, **beside, "files": "q*"})
    with pytest.raises(InputError, match="one angle for each"):
        read(folder, {**SAID, **beside})
    with pytest.raises(InputError, match="there is nothing"):
        read(folder, {**SAID, **beside, "files": "p*", "flats": tmp_path / "none.tif"})


def test_broken_images_and_archives_are_named(tmp_path):
    (tmp_path / "bad.tif").write_bytes(b"II*\0 no image")
    with pytest.raises(InputError, match=r"bad\.tif must"):
        read(tmp_path / "bad.tif", SAID)
    Image.fromarray(np.arange(48, dtype=np.uint8).reshape(4, 4, 3)).save(tmp_path / "rgb.png")
    with pytest.raises(InputError, match="must hold grey images"):
        read(tmp_path / "rgb.png", SAID)
    np.savez(tmp_path / "text.npz", counts=np.array(["a"]))
    with pytest.raises(InputError, match="counts must hold numbers"):
        read(tmp_path / "text.npz", SAID)
    with pytest.raises(InputError, match="corrected frames already"), open_raw(_tiff_scan(tmp_path), {}):
        pass


def _tiff_scan(tmp_path: Path) -> Path:
    write_tiff(tmp_path / "scan", read(archive(tmp_path / "a.npz"), SAID))
    return tmp_path / "scan"
