"""Runs of the European XFEL, made by the mock of extra_data: cameras as views, trains and pulses as times."""

from __future__ import annotations

import pickle
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from holosplat.checks import InputError
from holosplat.geometry import rotation_y
from holosplat.io import euxfel, hdf5_guard
from holosplat.io.formats import loader_of, read, read_as
from holosplat.io.reading import Reading, Told
from holosplat.workflows.correct import CorrectionOptions, correct

mockdata = pytest.importorskip("extra_data.tests.mockdata", reason="extra_data is not installed")
from extra_data.tests.mockdata.base import DeviceBase  # noqa: E402

TRAINS, PULSES, H, W = 3, 4, 5, 8
SAID = {"energy_kev": 9.3, "distance": 0.4, "pixel_size": 3.2e-6, "frame_rate": 1.128e6}
CAMERA = "SPB_EHD_HPVX2_{}/CAM/CAMERA"


class Camera(DeviceBase):
    """A burst camera as the data acquisition writes it: all frames of a train in one entry."""

    output_channels = ("daqOutput/data",)
    instrument_keys = (("image/pixels", "u2", (PULSES, H, W)), ("image/bitsPerPixel", "i4", ()))


def run_of(folder: Path, *counts: np.ndarray) -> Path:
    """A run of one camera for each array [trains, pulses, H, W]."""
    folder.mkdir()
    file = folder / "RAW-R0007-DA01-S00000.h5"
    devices = [Camera(CAMERA.format(n + 1)) for n in range(len(counts))]
    mockdata.write_file(str(file), devices, ntrains=TRAINS, chunksize=TRAINS, format_version="1.2")
    with h5py.File(file, "r+") as opened:
        for n, frames in enumerate(counts):
            opened[f"INSTRUMENT/{CAMERA.format(n + 1)}:daqOutput/data/image/pixels"][:] = frames
    return folder


def counts_of(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(400, 900, (TRAINS, PULSES, H, W))


@pytest.fixture
def run(tmp_path) -> Path:
    return run_of(tmp_path / "r0007", counts_of(0), counts_of(1))


@pytest.fixture
def angles(tmp_path) -> Path:
    (tmp_path / "angles.txt").write_text("0\n23.8\n")
    return tmp_path / "angles.txt"


def test_cameras_are_views_and_trains_and_pulses_times(run, angles):
    found = read_as(run, Reading(Told(**SAID, angles=angles)))
    assert loader_of(run).name == "euxfel"
    wanted = np.stack([counts_of(0), counts_of(1)], axis=2).reshape(-1, H, W)
    np.testing.assert_array_equal(found.frames, wanted)
    assert found.is_series
    np.testing.assert_allclose(found.views.rotations, np.tile(rotation_y([0, 23.8]), (TRAINS * PULSES, 1, 1)))
    times = (0.1 * np.arange(TRAINS)[:, None] + np.arange(PULSES) / 1.128e6).ravel()
    np.testing.assert_allclose(found.exposures.time, np.repeat(times, 2), atol=1e-12)
    assert "HPVX2_2" in found.provenance["euxfel_sources"]
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(found.source))[[5]], wanted[[5]])


def test_cameras_trains_and_pulses_are_chosen(run):
    told = Told(**SAID, sources="HPVX2_2", trains="1", pulses="1:4:2")
    found = read_as(run, Reading(told))
    np.testing.assert_array_equal(found.frames, counts_of(1)[1, [1, 3]])
    np.testing.assert_allclose(found.exposures.time, [0, 2 / 1.128e6])
    one = read(run, {**SAID, "frame_rate": None, "sources": "HPVX2_1", "pulses": "2"})
    np.testing.assert_array_equal(one.frames, counts_of(0)[:, 2])


def test_each_camera_is_corrected_by_its_own_flats_and_darks(run, angles, tmp_path):
    """While reading, and by the command, one camera at a time."""
    light = [900 + 50 * np.arange(W) * np.ones((H, 1)), 1500 + 20 * np.arange(H)[:, None] * np.ones(W)]
    flats = run_of(tmp_path / "flats", *(np.broadcast_to(f + 30, (TRAINS, PULSES, H, W)) for f in light))
    darks = run_of(tmp_path / "darks", *(np.full((TRAINS, PULSES, H, W), 30) for _ in light))
    beside = {"flats": flats, "darks": darks}
    found = read_as(run, Reading(Told(**SAID, angles=angles, **beside)))
    for n in range(2):
        np.testing.assert_allclose(found.frames[n::2], (counts_of(n).reshape(-1, H, W) - 30) / light[n], rtol=1e-6)
    with pytest.raises(InputError, match="choose one by --sources, and join"):
        correct(run, tmp_path / "out.nxs", CorrectionOptions("plain"), reading=Reading(Told(**SAID, **beside)))
    reading = Reading(Told(**SAID, sources="HPVX2_2", **beside))
    correct(run, tmp_path / "out.nxs", CorrectionOptions("plain"), reading=reading)
    np.testing.assert_allclose(read(tmp_path / "out.nxs").frames, found.frames[1::2], rtol=1e-5)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"sources": "ZYLA"}, "must have cameras named ZYLA, but those with data.image.pixels are SPB_EHD_HPVX2_1"),
        ({"trains": "3"}, "--trains counts what there is from 0 to 2, but it says 3"),
        ({"pulses": "4:9"}, "--pulses must name some, but '4:9' names none of the 4"),
        ({"frame_rate": None}, "say it by --frame-rate"),
        ({"energy_kev": None}, "does not say the photon energy; say it by --energy-kev"),
        ({"sources": "HPVX2"}, "does not say the frames' angles; name a text file of them by --angles FILE"),
        ({"darks": "here"}, "must be a run of the European XFEL"),
    ],
)
def test_what_a_run_does_not_have_or_say_is_named(run, change, said, tmp_path):
    given = {**SAID, "sources": "HPVX2_1", **change}
    if "darks" in given:
        given["darks"] = tmp_path
    with pytest.raises(InputError, match=said):
        read(run, given)


def stored_elsewhere(run: Path, shape=(TRAINS, PULSES, H, W), dtype="u2", **how) -> str:
    """Put the pixels of the first camera in place of those of the run; the name of the dataset."""
    name = f"INSTRUMENT/{CAMERA.format(1)}:daqOutput/data/image/pixels"
    with h5py.File(run / "RAW-R0007-DA01-S00000.h5", "r+") as file:
        del file[name]
        if "layout" in how:
            file.create_virtual_dataset(name, how["layout"])
        else:
            file.create_dataset(name, shape, dtype, **how)
    return name


@pytest.mark.parametrize("kind", ["external", "virtual"])
def test_a_run_brings_values_of_other_files_only_where_that_is_allowed(run, tmp_path, monkeypatch, kind):
    """External storage and virtual datasets read any file of this machine."""
    monkeypatch.setattr(hdf5_guard, "_vouched", set())
    frames = counts_of(5).astype("u2")
    if kind == "external":
        frames.tofile(tmp_path / "values")
        stored_elsewhere(run, external=[(str(tmp_path / "values"), 0, frames.nbytes)])
    else:
        with h5py.File(tmp_path / "other.h5", "w") as file:
            file["a"] = frames
        layout = h5py.VirtualLayout(frames.shape, "u2")
        layout[:] = h5py.VirtualSource(str(tmp_path / "other.h5"), "a", frames.shape)
        stored_elsewhere(run, layout=layout)
    told = Told(**SAID, sources="HPVX2_1")
    with pytest.raises(InputError, match="has its values in another file; if you trust both, add --allow-external"):
        read_as(run, Reading(told))
    with pytest.raises(InputError, match="add --allow-external"):
        read_as(run_of(tmp_path / "r2", counts_of(1)), Reading(Told(**SAID, sources="HPVX2_1", flats=run)))
    found = read_as(run, Reading(replace(told, allow_external=True)))
    np.testing.assert_array_equal(found.frames, frames.reshape(-1, H, W))


@pytest.mark.parametrize(
    ("shape", "dtype"),
    [
        ((TRAINS, PULSES, H, W), h5py.string_dtype()),
        ((TRAINS, PULSES, H, W), "c8"),
        ((TRAINS, PULSES, H, W), h5py.ref_dtype),
        ((1, PULSES, H, W), "u2"),
        ((TRAINS, PULSES, 0, W), "u2"),
        ((TRAINS,), "u2"),
    ],
)
def test_pixels_that_are_none_or_too_few_are_refused(run, shape, dtype):
    stored_elsewhere(run, shape, dtype)
    with pytest.raises(InputError, match="r0007"):
        np.asarray(read(run, {**SAID, "sources": "HPVX2_1"}).frames)


def test_pixels_that_are_marked_or_dark_or_no_numbers_are_missing(tmp_path, angles):
    """By the facility's mask, by flats that are no brighter than darks, and by what is written for them."""
    counts = [counts_of(0), counts_of(1)]
    counts[0][0, 1, 4, 7] = 60000
    light, dark = np.full((2, TRAINS, PULSES, H, W), 930), np.full((2, TRAINS, PULSES, H, W), 30)
    light[1, :, :, 3, 5] = 30
    run, flats, darks = (
        run_of(tmp_path / name, *values) for name, values in (("r", counts), ("flats", light), ("darks", dark))
    )
    mask = np.zeros((TRAINS, PULSES, H, W), "u4")
    mask[0, 1, 4, 7] = 2
    add_masks(run, mask, np.zeros_like(mask))
    found = read_as(run, Reading(Told(**SAID, angles=angles, flats=flats, darks=darks)))
    wanted = np.zeros((TRAINS, PULSES, 2, H, W), bool)
    wanted[0, 1, 0, 4, 7] = wanted[:, :, 1, 3, 5] = True
    np.testing.assert_array_equal(found.missing, wanted.reshape(-1, H, W))
    assert found.frames.max() < 2
    reading = Reading(Told(**SAID, sources="HPVX2_1", flats=flats, darks=darks))
    correct(run, tmp_path / "out.nxs", CorrectionOptions("plain"), reading=reading)
    corrected = read(tmp_path / "out.nxs")
    assert corrected.missing is not None
    assert corrected.missing.sum() == TRAINS * PULSES
    assert corrected.missing[:, 4, 7].all()


def add_masks(run: Path, *masks: np.ndarray) -> None:
    """The mask of each camera, [trains, pulses, H, W], not 0 for defective pixels."""
    with h5py.File(run / "RAW-R0007-DA01-S00000.h5", "r+") as file:
        for n, mask in enumerate(masks):
            file[f"INSTRUMENT/{CAMERA.format(n + 1)}:daqOutput/data/image/mask"] = mask


def test_without_the_package_its_name_is_said(run, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "extra_data", None)
    euxfel._run.cache_clear()
    with pytest.raises(InputError, match=r"holosplat\[euxfel\]"):
        read(run, SAID)


def test_trains_that_are_lost_are_said(run, angles, caplog):
    """Of the second camera a train has no frames."""
    with h5py.File(run / "RAW-R0007-DA01-S00000.h5", "r+") as file:
        index = file[f"INDEX/{CAMERA.format(2)}:daqOutput/data"]
        index["count"][1] = 0
    euxfel._run.cache_clear()
    found = read_as(run, Reading(Told(**SAID, angles=angles)))
    assert len(found) == 2 * (TRAINS - 1) * PULSES
    assert f"1 of {TRAINS} trains are lost, for not all cameras have them: 10001" in caplog.text
