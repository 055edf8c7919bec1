"""Odd flats, darks, exposures and pixels of real users: read right, left out or filled, and said."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest

from helpers.odd_files import ANGLES, FRAMES, PIXEL, SHAPE, N, a_scan, images, numbered, said
from holosplat.checks import InputError
from holosplat.io.formats import read_as, read_frames
from holosplat.io.nxtomo import RawLayout, read_scan, scan_writer, write_scan
from holosplat.io.reading import Reading, Told

# --- flats and darks ----------------------------------------------------------------------------------------------


def raw_file(path: Path, flats: np.ndarray, darks: np.ndarray) -> Path:
    kinds = np.array([1] * len(flats) + [2] * len(darks) + [0] * N)
    exposures = a_scan().exposures[np.zeros(len(kinds), dtype=int)]
    layout = RawLayout(kinds, np.zeros(SHAPE))
    with scan_writer(path, exposures, np.zeros(len(kinds), bool), {}, layout) as add:
        for frame in (*flats, *darks, *FRAMES):
            add(frame)
    return path


FLATS, DARKS = np.full((4, *SHAPE), 5010), np.full((4, *SHAPE), 10)
SAMPLE_IN = np.where(np.arange(SHAPE[1]) < 9, 3000, 5010)


@pytest.mark.parametrize(
    ("flats", "darks", "odd"),
    [
        (FLATS, DARKS, ""),
        (FLATS * np.array([1, 1.1, 0.7, 1])[:, None, None], DARKS, ""),
        (FLATS, np.where(np.arange(4)[:, None, None] == 2, 5010, DARKS), "darks, frame 6 is left out"),
        (np.where(np.arange(4)[:, None, None] == 1, 10, FLATS), DARKS, "flats, frame 1 is left out"),
        (np.where(np.arange(4)[:, None, None] == 3, SAMPLE_IN, FLATS), DARKS, "flats, frame 3 is left out"),
        (np.where(np.arange(4)[:, None, None] == 3, 65535, FLATS), DARKS, "flats, frame 3 is left out"),
    ],
)
def test_flats_and_darks_unlike_the_others_are_left_out_and_named(tmp_path, caplog, flats, darks, odd):
    caplog.set_level("WARNING")  # what a command says beside, in the same process, is no warning
    rng = np.random.default_rng(0)
    noisy = [np.rint(each + rng.normal(0, 2, each.shape)).clip(0) for each in (flats, darks)]
    scan = read_scan(raw_file(tmp_path / "raw.nxs", *noisy))
    assert odd in caplog.text
    assert bool(caplog.records) == bool(odd)
    level = 5000 if odd or flats is FLATS else 4753
    np.testing.assert_allclose(scan.frames, (FRAMES - 10.0) / level, atol=3e-3)


@pytest.mark.parametrize(
    ("flat", "dark", "said"),
    [
        (0.1, 0.1005, []),
        (0.1, 1.0, ["darks were exposed 1 s, but projections 0.1 s"]),
        (0.2, 0.1, ["flats were exposed 0.2 s, but projections 0.1 s"]),
    ],
)
def test_flats_and_darks_of_another_time_are_warned_of(tmp_path, caplog, flat, dark, said):
    path = raw_file(tmp_path / "raw.nxs", FLATS, DARKS)
    with h5py.File(path, "r+") as file:
        file["entry/instrument/detector/count_time"] = np.r_[np.full(4, flat), np.full(4, dark), np.full(N, 0.1)]
    read_scan(path)
    assert len(caplog.records) == len(said)
    assert all(words in caplog.text for words in said)


def test_frames_are_left_out_by_number(tmp_path, caplog):
    darks = np.where(np.arange(4)[:, None, None] == 2, 510, DARKS)
    path = raw_file(tmp_path / "raw.nxs", FLATS, darks)
    scan = read_scan(path, {"leave_out": "6,8"})
    np.testing.assert_allclose(scan.frames, (FRAMES[1:] - 10.0) / 5000, rtol=1e-5)
    assert not caplog.records
    read_scan(path, {"leave_out": "8"})
    assert "frame 6 stays" in caplog.text


def test_two_darks_that_differ_are_refused(tmp_path):
    path = raw_file(tmp_path / "raw.nxs", FLATS, np.stack([DARKS[0], FLATS[0]]))
    with pytest.raises(
        InputError, match=r"darks that are alike and no flats, but frame 4, frame 5 differ; .*--leave-out"
    ):
        read_scan(path)


@pytest.mark.parametrize(
    ("flats", "darks", "words"),
    [
        (
            FLATS,
            np.where(np.arange(4)[:, None, None] > 0, 5010, DARKS),
            "no flats, but frame 5, frame 6, frame 7 differ",
        ),
        (FLATS, FLATS[:1], "no flats, but frame 4 differ"),
        (np.where(np.arange(4)[:, None, None] > 0, 11, FLATS), DARKS, "no darks, but frame 1, frame 2, frame 3 differ"),
    ],
)
def test_flats_and_darks_that_are_mostly_the_other_are_refused(tmp_path, flats, darks, words):
    with pytest.raises(InputError, match=words):
        read_scan(raw_file(tmp_path / "raw.nxs", flats, darks))


def test_darks_that_are_missing_are_said(tmp_path, caplog):
    read_scan(raw_file(tmp_path / "raw.nxs", FLATS, DARKS[:0]))
    assert "flats, but no darks: the counts without light are taken as 0; add --darks" in caplog.text


def test_dead_pixels_have_no_weight(tmp_path, caplog):
    path = raw_file(tmp_path / "raw.nxs", np.where(np.arange(SHAPE[1]) < 6, 0, FLATS), DARKS)
    with pytest.raises(
        InputError, match="flats that are brighter than its darks, but in 25% of the pixels they are not"
    ):
        read_scan(path)
    path = raw_file(tmp_path / "raw.nxs", np.where(np.arange(SHAPE[1]) == 5, 0, FLATS), DARKS)
    found = read_scan(path)
    assert found.missing is not None
    assert found.missing[:, :, 5].all()
    assert found.missing.mean() == 1 / SHAPE[1]
    assert f"pixels whose flats are not brighter than the darks ({SHAPE[0]}) are filled" in caplog.text
    np.testing.assert_allclose(found.frames, (FRAMES - 10.0) / 5000, atol=3e-3)
    with h5py.File(path, "a") as file:
        file["entry/instrument/detector/pixel_mask"][:, 5] = 1
    np.testing.assert_allclose(read_scan(path).frames, (FRAMES - 10.0) / 5000, atol=3e-3)
    with h5py.File(path, "a") as file:
        file["entry/instrument/detector/pixel_mask"][:] = 1
    with pytest.raises(InputError, match="pixel_mask marks 100% of the pixels"):
        read_scan(path)


def as_nexus(path: Path, frames: np.ndarray, key: int) -> None:
    with h5py.File(path, "w") as file:
        detector = file.create_group("entry/instrument/detector")
        detector["data"], detector["image_key"] = frames, np.full(len(frames), key)
        detector["count_time"] = np.ones(len(frames))


def as_array(path: Path, frames: np.ndarray, key: int) -> None:
    np.savez(path, frames=frames) if path.suffix == ".npz" else np.save(path, frames)


def as_exchange(path: Path, frames: np.ndarray, key: int) -> None:
    with h5py.File(path, "w") as file:
        file["exchange/data"] = np.zeros((N, *SHAPE))
        file["exchange/" + ("data_white" if key == 1 else "data_dark")] = frames


@pytest.mark.parametrize(
    ("writes", "name"), [(as_nexus, "f.nxs"), (as_array, "f.npz"), (as_array, "f.npy"), (as_exchange, "f.h5")]
)
def test_flats_and_darks_may_have_any_format(tmp_path, writes, name):
    images(tmp_path / "scan", numbered(N), FRAMES)
    flats, darks, angles = tmp_path / f"flats_{name}", tmp_path / f"darks_{name}", tmp_path / "angles.txt"
    writes(flats, FLATS, 1)
    writes(darks, DARKS, 2)
    angles.write_text("\n".join(map(str, ANGLES)))
    scan = read_as(tmp_path / "scan", said(angles=angles, flats=flats, darks=darks))
    np.testing.assert_allclose(scan.frames, (FRAMES - 10.0) / 5000, rtol=1e-6)


# --- NXtomo -------------------------------------------------------------------------------------------------------


def of_library(path: Path, also: dict[str, tuple[object, str]]) -> Path:
    """A file as the nxtomo library writes it, with more entries."""
    entries: dict[str, tuple[object, str]] = {
        "instrument/detector/data": (FRAMES / 5000, ""),
        "instrument/detector/x_pixel_size": (3.2, "micron/pixel"),
        "instrument/detector/y_pixel_size": (3.2, "um"),
        "instrument/detector/distance": (0.1, "meters"),
        "instrument/beam/incident_energy": (20.0, "Kilo electron-volts"),
        "sample/rotation_angle": (ANGLES, "Degrees"),
    }
    with h5py.File(path, "w") as file:
        for name, (value, unit) in {**entries, **also}.items():
            file[f"entry/{name}"] = value
            file[f"entry/{name}"].attrs["units"] = unit
    return path


def test_the_axis_of_the_file_is_taken_unless_another_is_said(tmp_path):
    axis = {"instrument/detector/x_rotation_axis_pixel_position": (-4.0, "pixel")}
    path = of_library(tmp_path / "a.nxs", axis)
    assert read_scan(path).views.shifts[0, 0] == pytest.approx(4 * PIXEL)
    assert read_as(path, Reading(Told(axis_column=10.5))).views.shifts[0, 0] == pytest.approx(PIXEL)
    path = of_library(tmp_path / "b.nxs", {**axis, "instrument/detector/x_flipped": (True, "")})
    assert read_scan(path).views.shifts[0, 0] == pytest.approx(-4 * PIXEL)
    far = {"instrument/detector/x_rotation_axis_pixel_position": (40.0, "pixel")}
    with pytest.raises(InputError, match="must count columns from the middle of 24"):
        read_scan(of_library(tmp_path / "c.nxs", far))


def test_the_axis_may_be_said_in_metres_and_half_a_view_is_warned_of(tmp_path, caplog):
    axis = {"instrument/detector/x_rotation_axis_pixel_position": (-12.8, "um")}
    assert read_scan(of_library(tmp_path / "a.nxs", axis)).views.shifts[0, 0] == pytest.approx(4 * PIXEL)
    read_scan(of_library(tmp_path / "b.nxs", {"instrument/detector/field_of_view": ("Half", "")}))
    assert "says Half, but no axis is said" in caplog.text


@pytest.mark.parametrize(
    ("depends", "mirrored"), [(".", False), ("transformations/turn", True), ("/entry/other/turn", False), (None, True)]
)
def test_the_detector_is_turned_by_what_it_depends_on(tmp_path, depends, mirrored):
    path = of_library(tmp_path / "a.nxs", {} if depends is None else {"instrument/detector/depends_on": (depends, "")})
    with h5py.File(path, "a") as file:
        for place, kind in (("instrument/detector/transformations", "rotation"), ("other", "translation")):
            file[f"entry/{place}/turn"] = 180.0
            file[f"entry/{place}/turn"].attrs.update(transformation_type=kind, units="deg", vector=(0, 0, 1))
    expected = FRAMES[:, :, ::-1] if mirrored else FRAMES
    np.testing.assert_allclose(read_scan(path).frames, expected / 5000, rtol=1e-6)


def test_a_source_near_by_makes_pixels_and_distance_smaller(tmp_path, caplog):
    scan = read_scan(of_library(tmp_path / "a.nxs", {"instrument/source/distance": (-0.3, "m")}))
    assert scan.views.pixel_size == pytest.approx(PIXEL * 0.75)
    np.testing.assert_allclose(scan.exposures.distance, 0.075)
    known = {"sample/propagation_distance": (0.05, "m"), "sample/x_pixel_size": (1.0, "um")}
    known |= {"instrument/source/distance": (-0.3, "m"), "sample/y_pixel_size": (1.0, "um")}
    scan = read_scan(of_library(tmp_path / "b.nxs", known))
    assert scan.views.pixel_size == pytest.approx(1e-6)
    np.testing.assert_allclose(scan.exposures.distance, 0.05)
    near = {"instrument/source/distance": (-1e-3, "m"), "instrument/detector/distance": (1e-4, "m")}
    cone = read_scan(of_library(tmp_path / "c.nxs", near))
    assert cone.views.sources.tolist() == [1e-3] * len(cone)
    assert cone.views.pixel_size == pytest.approx(PIXEL / 1.1)
    far = read_scan(of_library(tmp_path / "d.nxs", {"instrument/source/distance": (-145.0, "m")}))
    assert far.views.pixel_size == pytest.approx(PIXEL)
    assert far.views.sources is None


@pytest.mark.parametrize(
    ("vector", "coordinates", "turn"),
    [
        ((0, 0, 1), None, np.s_[:, :, ::-1]),
        ((0, 1, 0), None, np.s_[:, ::-1]),
        ((0, 1, 0), "McStas", np.s_[:, :, ::-1]),
        ((0, 0, 1), "McStas", np.s_[:, ::-1, ::-1]),
    ],
)
def test_half_turns_of_the_detector_turn_frames_upright(tmp_path, vector, coordinates, turn):
    path = of_library(tmp_path / "a.nxs", {"instrument/detector/transformations/r": (180.0, "degree")})
    with h5py.File(path, "a") as file:
        item = file["entry/instrument/detector/transformations/r"]
        item.attrs.update({"transformation_type": "rotation", "vector": vector})
        if coordinates:
            file["entry"].attrs["NeXus_Coordinate_System"] = coordinates
    np.testing.assert_allclose(read_scan(path).frames, (FRAMES / 5000)[turn], rtol=1e-6)
    with h5py.File(path, "a") as file:
        file["entry/instrument/detector/transformations/r"][()] = 90.0
    with pytest.raises(InputError, match="turns the detector by 90 degrees"):
        read_scan(path)


def test_a_sample_that_moves_is_warned_of(tmp_path, caplog):
    still = {"sample/x_translation": (np.full(N, 3.0), "mm")}
    read_scan(of_library(tmp_path / "a.nxs", still))
    assert not caplog.records
    read_scan(of_library(tmp_path / "b.nxs", {"sample/z_translation": (PIXEL * np.arange(N), "m")}))
    assert "z_translation moves the sample by 22.4\N{NO-BREAK SPACE}µm between the projections" in caplog.text


# --- pixels -------------------------------------------------------------------------------------------------------


def test_marked_pixels_are_filled_and_their_number_is_said(tmp_path, caplog):
    caplog.set_level("INFO")
    frames = (FRAMES / 5000).astype(np.float32)
    broken = frames.copy()
    broken[:, 4, 5] = np.nan
    mask = np.zeros(SHAPE, np.uint32)
    mask[4, 5] = 1
    path = of_library(
        tmp_path / "a.nxs", {"instrument/detector/data": (broken, ""), "instrument/detector/pixel_mask": (mask, "")}
    )
    np.testing.assert_allclose(read_scan(path).frames, frames, rtol=1e-4)
    assert "pixels that the file marks as defective (1) are filled" in caplog.text


def test_pixels_that_no_light_can_be_are_filled_for_those_who_use_them(tmp_path, caplog):
    frames = (1 + FRAMES / 5000).astype(np.float32)
    broken = frames.copy()
    broken[3, 4, 5], broken[3, 9, 9] = -1, 0
    write_scan(tmp_path / "a.nxs", a_scan(frames=broken))
    np.testing.assert_array_equal(read_as(tmp_path / "a.nxs", Reading()).frames, broken)
    assert not caplog.records
    np.testing.assert_allclose(read_frames(tmp_path / "a.nxs", Reading()).frames, frames, rtol=1e-3)
    assert "pixels that are not above 0, no numbers or saturated (2 in 1 of 8 frames) are filled" in caplog.text
    broken[3, :9] = 0
    write_scan(tmp_path / "a.nxs", a_scan(frames=broken))
    with pytest.raises(InputError, match="45% of frame 3 are not"):
        _ = read_frames(tmp_path / "a.nxs", Reading()).frames
