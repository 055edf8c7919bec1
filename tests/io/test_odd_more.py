"""Other members of the kinds of odd files: several series in a folder, scales that differ, counts without a value."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile

from helpers.odd_files import ANGLES, FRAMES, SHAPE, N, a_scan, images, numbered, said
from holosplat.checks import InputError
from holosplat.geometry import Views, rotation_y
from holosplat.io.angles import read_angles
from holosplat.io.formats import read, read_as
from holosplat.io.nxtomo import RawLayout, read_scan, scan_writer, write_scan
from holosplat.scan import Exposures
from holosplat.workflows.correct import correct


@pytest.fixture
def angles(tmp_path: Path) -> Path:
    np.savetxt(tmp_path / "angles.txt", ANGLES)
    return tmp_path / "angles.txt"


@pytest.mark.parametrize(
    ("names", "words"),
    [
        (["a1.tif", "a2.tif", *(f"b{n}.tif" for n in range(3, N + 1))], "2 as a1.tif, 6 as b3.tif"),
        ([*numbered(N - 1), "001 (copy).tif"], "7 as 000.tif, 1 as 001 (copy).tif"),
        (["average.tif", *numbered(N - 1)], "7 as 000.tif, 1 as average.tif"),
    ],
)
def test_names_of_several_series_are_warned_of(tmp_path, angles, caplog, names, words):
    read_as(images(tmp_path / "frames", names, FRAMES), said(angles=angles))
    assert words in caplog.text


def test_names_without_numbers_are_one_series(tmp_path, angles, caplog):
    caplog.set_level("WARNING")
    read_as(images(tmp_path / "frames", [f"{letter}.tif" for letter in "abcdefgh"], FRAMES), said(angles=angles))
    assert not caplog.records


def test_images_of_several_scales_are_refused(tmp_path, angles):
    folder = images(tmp_path / "frames", numbered(N), FRAMES)
    tifffile.imwrite(folder / "003.tif", (FRAMES[3] % 200).astype(np.uint8))
    with pytest.raises(
        InputError, match=r"003\.tif must hold numbers of uint16 as the first image, but they are uint8"
    ):
        read_as(folder, said(angles=angles)).frames  # noqa: B018


def test_colours_that_are_equal_are_said(tmp_path, angles, caplog):
    caplog.set_level("INFO")
    tifffile.imwrite(tmp_path / "rgb.tif", np.repeat(FRAMES[..., None], 3, axis=-1), photometric="rgb")
    found = read_as(tmp_path / "rgb.tif", said(angles=angles))
    assert "three equal colours, of which one is taken" in caplog.text
    np.testing.assert_array_equal(found.frames, FRAMES)


@pytest.mark.parametrize(
    ("degrees", "words"),
    [
        ([0, 22.5, 45, 45, 90, 112.5, 135, 157.5], "more than one frame has the angle 45°;"),
        ([0, 45, 45, 90, 135, 180, 225, 405], "more than one frame has the angle 45°;"),
        (np.linspace(0, 360, N), ""),
        (np.repeat(ANGLES[::2], 2), ""),
    ],
)
def test_angles_that_come_again_are_warned_of(tmp_path, caplog, degrees, words):
    caplog.set_level("WARNING")
    write_scan(tmp_path / "scan.nxs", a_scan(np.asarray(degrees, dtype=float)))
    read_as(tmp_path / "scan.nxs", said())
    assert words in caplog.text
    assert bool(caplog.records) == bool(words)


@pytest.mark.parametrize("unit", ["deg", "rad"])
def test_a_row_of_units_says_the_unit(tmp_path, unit):
    factor = 1.0 if unit == "deg" else np.pi / 180
    rows = [f"{n};{angle * factor:.6f}".replace(".", ",") for n, angle in enumerate(ANGLES)]
    (tmp_path / "angles.csv").write_text("\n".join(["nr;angle", f";{unit}", *rows]))
    np.testing.assert_allclose(read_angles(tmp_path / "angles.csv"), ANGLES, atol=1e-4)


def test_angles_without_a_unit_that_look_like_radians_are_refused(tmp_path):
    np.savez(tmp_path / "scan.npz", counts=FRAMES / 5000, angles=np.deg2rad(ANGLES))
    with pytest.raises(
        InputError, match=r"angles must hold angles in degrees, but those from 0 to 2\.749 look like rad"
    ):
        read_as(tmp_path / "scan.npz", said())
    with h5py.File(tmp_path / "aps.h5", "w") as file:
        file["exchange/data"], file["exchange/theta"] = FRAMES, np.deg2rad(ANGLES)
    with pytest.raises(InputError, match=r"theta must hold angles in degrees.*say which they are by @units"):
        read_as(tmp_path / "aps.h5", said())
    with h5py.File(tmp_path / "aps.h5", "a") as file:
        file["exchange/theta"].attrs["units"] = "rad"
    np.testing.assert_allclose(read_as(tmp_path / "aps.h5", said()).views.rotations, rotation_y(ANGLES), atol=1e-9)


def test_angles_taken_as_radians_are_warned_of(tmp_path, caplog):
    write_scan(tmp_path / "scan.nxs", a_scan())
    with h5py.File(tmp_path / "scan.nxs", "a") as file:
        del file["entry/sample/view_rotation"], file["entry/sample/rotation_angle"].attrs["units"]
        put = file["entry/sample/rotation_angle"]
        assert isinstance(put, h5py.Dataset)
        put[...] = 1.5 * np.arange(N)
    read_scan(tmp_path / "scan.nxs")
    assert "has no @units: its angles, up to 10.5, are taken as radians" in caplog.text


def test_a_wavelength_stands_for_the_energy(tmp_path):
    write_scan(tmp_path / "scan.nxs", a_scan())
    with h5py.File(tmp_path / "scan.nxs", "a") as file:
        del file["entry/instrument/beam/incident_energy"]
        file["entry/instrument/beam/incident_wavelength"] = 0.61992099
        file["entry/instrument/beam/incident_wavelength"].attrs["units"] = "angstrom"
    assert read(tmp_path / "scan.nxs").exposures.energy_kev[0] == pytest.approx(20, rel=1e-6)


def saturated(path: Path) -> tuple[Path, np.ndarray, np.ndarray]:
    """Raw counts of which the first 10 pixels of one frame, and pixel (5, 6) of the flats, are at the greatest number;
    the relative intensities, and which pixels have none."""
    rng, light = np.random.default_rng(0), 20000.0
    kinds = np.array([1] * 4 + [2] * 4 + [0] * N)
    true = 1 - 0.2 * rng.random((N, *SHAPE))
    fields = [light + 100 + rng.normal(0, 20, (4, *SHAPE)), 100 + rng.normal(0, 2, (4, *SHAPE))]
    frames = np.rint(np.concatenate([*fields, 100 + light * true]))
    lost = np.zeros((N, *SHAPE), dtype=bool)
    lost[2, 0, :10] = lost[:, 5, 6] = True
    frames[8 + 2, 0, :10] = frames[1, 5, 6] = 65535
    exposures = a_scan().exposures[np.zeros(len(kinds), dtype=int)]
    with scan_writer(path, exposures, np.zeros(len(kinds), bool), {}, RawLayout(kinds, np.zeros(SHAPE))) as add:
        for frame in frames:
            add(frame)
    return path, true, lost


def test_saturated_counts_have_no_weight(tmp_path, caplog):
    path, true, lost = saturated(tmp_path / "raw.nxs")
    found = read_scan(path)
    np.testing.assert_allclose(found.frames[~lost], true[~lost], atol=3e-3)
    np.testing.assert_array_equal(found.missing, lost)
    assert "pixels whose flats are saturated (1) are filled" in caplog.text
    assert "pixels that are not above 0, no numbers or saturated (10 in 1 of 8 frames)" in caplog.text


@pytest.mark.parametrize("method", ["plain", "dynamic"])
def test_corrected_frames_keep_what_was_saturated(tmp_path, method):
    from holosplat.workflows.correct import CorrectionOptions

    path, true, lost = saturated(tmp_path / "raw.nxs")
    correct(path, tmp_path / "out.nxs", CorrectionOptions(method=method, normalise="none"))
    found = read(tmp_path / "out.nxs")
    np.testing.assert_array_equal(found.missing, lost)
    np.testing.assert_allclose(found.frames[~lost], true[~lost], atol=0.02)


def test_flats_that_are_saturated_are_refused(tmp_path):
    with h5py.File(tmp_path / "raw.h5", "w") as file:
        file["counts"], file["angles_deg"] = FRAMES, ANGLES
        file["flats"] = np.full((3, *SHAPE), 65535, dtype=np.uint16)
    with pytest.raises(InputError, match="in 100% of the pixels they are not, or saturated"):
        read_as(tmp_path / "raw.h5", said())


def test_flats_of_another_brightness_are_said(tmp_path, caplog):
    caplog.set_level("INFO")
    flats = np.full((3, *SHAPE), 5000, dtype=np.uint16)
    flats[2] = 5500
    with h5py.File(tmp_path / "raw.h5", "w") as file:
        file["counts"], file["angles_deg"], file["flats"] = FRAMES, ANGLES, flats
    read_as(tmp_path / "raw.h5", said())
    assert "flats differ in brightness: frame 10 has 1.1 times the usual light" in caplog.text


# --- frames that are not what the file says -------------------------------------------------------------------------


def turned(path: Path, flats: np.ndarray, *odd: np.ndarray) -> Path:
    """Counts of ten square frames of a ball that turns about the axis, the last ones being `odd`, behind such flats
    [n, 40, 40] and four darks of 100."""
    rng, count = np.random.default_rng(1), 10
    y, x = np.indices((40, 40)) - 19.5
    places = 9 * np.cos(np.linspace(0, np.pi, count))
    thick = np.sqrt(np.maximum(0, 49 - (y - 4) ** 2 - (x - places[:, None, None]) ** 2))
    frames = [*(LIGHT * np.exp(-0.02 * thick))[: count - len(odd)], *odd]
    kinds = np.array([1] * len(flats) + [2] * 4 + [0] * count)
    views = Views.evenly_spaced(len(kinds), (40, 40), 1e-6)
    exposures = Exposures.of(views, 20.0, 0.1)
    with scan_writer(path, exposures, np.zeros(len(kinds), bool), {}, RawLayout(kinds, np.zeros((40, 40)))) as add:
        for frame in (*flats, *np.zeros((4, 40, 40)), *frames):
            add(rng.poisson(frame) + 100)
    return path


ROWS = np.indices((40, 40))[0] / 40
LIGHT = 20000 * np.exp(-((ROWS - 0.4) ** 2) / 0.2)


@pytest.mark.parametrize(
    ("way", "name"),
    [(lambda flat: flat, ""), (lambda flat: flat.T, "transposed"), (lambda flat: flat[::-1], "upside down")],
)
def test_flats_that_lie_otherwise_are_named(tmp_path, caplog, way, name):
    caplog.set_level("WARNING")
    _ = read_scan(turned(tmp_path / "raw.nxs", np.stack([way(LIGHT)] * 3))).frames
    assert bool(caplog.records) == bool(name)
    assert f"pattern of the flats better if these are {name}" in caplog.text or not name


def test_flats_say_nothing_of_how_they_lie_where_light_is_even(tmp_path, caplog):
    caplog.set_level("WARNING")
    turned(tmp_path / "raw.nxs", np.full((3, 40, 40), 20000.0), *np.full((10, 40, 40), 19000.0))
    _ = read_scan(tmp_path / "raw.nxs").frames
    assert not caplog.records


def test_a_faint_sample_in_a_flat_is_said(tmp_path, caplog):
    caplog.set_level("WARNING")
    flats = np.stack([LIGHT] * 3)
    flats[1, 10:30, 12:25] *= 0.95
    _ = read_scan(turned(tmp_path / "raw.nxs", flats)).frames
    assert len(caplog.records) == 1
    assert "flats differ in pattern, frame 1 by 0.0" in caplog.text


@pytest.mark.parametrize("act", [read_scan, lambda path: correct(path, path.with_name("out.nxs"))])
def test_projections_without_the_sample_or_without_light_are_said(tmp_path, caplog, act):
    """None is refused: matter that is thick along a beam hides its light, too."""
    caplog.set_level("WARNING")
    for last in (LIGHT, np.full((40, 40), 30.0)):
        found = act(turned(tmp_path / "raw.nxs", np.stack([LIGHT] * 3), last))
        _ = getattr(found, "frames", None)
        (tmp_path / "raw.nxs").unlink()
    assert "there is matter in the other projections, but none in frame 16;" in caplog.text
    assert "beside the other projections there is no light in frame 16; if they are darks" in caplog.text
