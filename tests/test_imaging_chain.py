"""From a noise-free scan to raw counts and back: `record`, `correct`, `join`, and the source in `simulate`."""

from __future__ import annotations

import contextlib
import io
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import h5py
import numpy as np
import pytest

import holosplat.io.scan_file as scan_file
from holosplat.beamline.polychromatic import polychromatic_frames, read_spectrum, refilled
from holosplat.beamline.record import RecordingOptions, record
from holosplat.beamline.scenes import Filling
from holosplat.beamline.simulate import Simulation, simulate
from holosplat.checks import InputError
from holosplat.cli import main
from holosplat.geometry import Views, rotation_y
from holosplat.io.nxtomo import read_scan, write_scan
from holosplat.io.scan_file import DARK, FLAT, PROJECTION, open_scan
from holosplat.io.vtk import write_mesh
from holosplat.materials import HAEMOGLOBIN
from holosplat.optics.camera import Camera
from holosplat.optics.coherence import Spectrum
from holosplat.optics.illumination import Illumination
from holosplat.optics.resampling import Resampling
from holosplat.scan import Exposures, Scan
from holosplat.specimens.mesh_series import MeshSeries
from holosplat.specimens.red_cells import random_cells
from holosplat.specimens.scene import MeshScene
from holosplat.workflows.correct import CorrectionOptions, correct
from holosplat.workflows.join import join

PIXEL, SHAPE = 3.2e-6, (65, 80)
STEADY = Illumination(0.0, structure=0.0, variation=0.0, components=0, pointing=0.0, beam_width=1e3)
QUIET = Camera(16, read_noise=0.0, gain_spread=0.0, offset_spread=0.0, dead=0.0, hot=0.0)


def cells() -> MeshScene:
    h, w = SHAPE
    found = random_cells(5, (0.7 * w * PIXEL, 0.8 * h * PIXEL, 0.7 * w * PIXEL), 4, 16 * PIXEL)
    return MeshScene.of_one_material(found, HAEMOGLOBIN.delta_beta(20.0))


def taken(shape: tuple[int, int] = SHAPE, pixel: float = PIXEL, psf: float = 0.3, count: int = 4) -> Exposures:
    shifts = 1e-6 * np.arange(2 * count).reshape(count, 2)
    views = Views(rotation_y(45.0 * np.arange(count)), shifts, shape, pixel)
    exposures = Exposures.of(views, 20.0, 0.1, psf)
    return replace(exposures, time=1e-6 * np.arange(count))


@dataclass(frozen=True)
class Shop:
    """A noise-free scan, its raw counts, and the truth about them."""

    clean: Path
    raw: Path
    truth: Path


@pytest.fixture(scope="module")
def shop(tmp_path_factory) -> Shop:
    path = tmp_path_factory.mktemp("imaging")
    made = Shop(path / "clean.nxs", path / "raw.nxs", path / "truth.h5")
    write_scan(made.clean, simulate(cells(), taken(), oversample=4, is_test=np.array([0, 1, 0, 0], bool)))
    options = RecordingOptions(flats=60, darks=10, flip="both", seed=3)
    record(made.clean, made.raw, options, Camera(), Illumination(components=4), made.truth)
    return made


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


# --- recording


def test_the_raw_file_is_nxtomo_with_counts(shop):
    with h5py.File(shop.raw) as file:
        detector = file["/entry/instrument/detector"]
        assert detector["data"].dtype == np.uint16
        assert detector["image_key"][()].tolist() == [DARK] * 10 + [FLAT] * 60 + [PROJECTION] * 4
        assert (detector["x_flipped"][()], detector["y_flipped"][()]) == (True, True)
        assert len(file["/entry/sample/rotation_angle"]) == 74
        assert file["/entry/split"][()].tolist() == [0] * 70 + [0, 1, 0, 0]
        marked = detector["pixel_mask"][()][::-1, ::-1]
    with h5py.File(shop.truth) as file:
        assert np.array_equal(marked > 0, file["sensor/dead"][()] | file["sensor/hot"][()])
        assert set(np.unique(marked[file["sensor/hot"][()]])) <= {8}
        assert file["projections/weights"].shape == (4, 6)
    clean = read_scan(shop.clean)
    with open_scan(shop.raw) as file:
        for name in ("distance", "psf_sigma_px", "time"):
            assert np.array_equal(getattr(file.exposures, name), getattr(clean.exposures, name))
        assert np.array_equal(file.exposures.views.shifts, clean.views.shifts)
        assert np.array_equal(file.is_test, clean.is_test)
        assert not any("weights" in name or "energy" in name.split("_") for name in file.provenance())


def test_counts_are_the_light_that_the_truth_file_tells(shop):
    """Counts less offset, over gain, are Poisson about photons · energy · light · clean frame."""
    clean = read_scan(shop.clean).frames
    with h5py.File(shop.truth) as truth, open_scan(shop.raw) as raw:
        gain, offset = truth["sensor/gain"][()], truth["sensor/offset"][()]
        good = ~(truth["sensor/dead"][()] | truth["sensor/hot"][()])
        for i, n in enumerate(raw.numbers(PROJECTION)):
            light = truth["light/mean"][()] + np.tensordot(
                truth["projections/weights"][i], truth["light/components"][()], 1
            )
            photons = truth.attrs["photons_per_pixel"] * truth["projections/energy"][i] * light * clean[i]
            off = (raw.frame(n) - offset - gain * photons)[good]
            noise = np.sqrt(gain**2 * photons + 4 + 1 / 12)[good]
            assert rms(off / noise) == pytest.approx(1, abs=0.03)
            assert (off / noise).mean() == pytest.approx(0, abs=0.06)


def test_recording_is_repeatable_and_flips_are_undone_when_read(shop, tmp_path):
    options = RecordingOptions(flats=4, darks=2, seed=9)
    frames = {}
    for flip in ("none", "rows", "columns", "both", "none again"):
        out = tmp_path / f"{flip}.nxs"
        record(shop.clean, out, replace(options, flip=flip.split()[0]), Camera(), Illumination())
        with open_scan(out) as file:
            frames[flip] = np.stack([file.frame(n) for n in range(10)])
            assert np.array_equal(file.rows(7, slice(3, 9)), frames[flip][7, 3:9])
            mask = file.mask()
        with h5py.File(out) as file:
            stored = file["/entry/instrument/detector/data"][7]
        assert np.array_equal(stored[0, 0], frames[flip][7, -1 if flip in ("rows", "both") else 0][
            -1 if flip in ("columns", "both") else 0])  # fmt: skip
        assert np.array_equal(mask, frames["none"].mean(0) * 0 + mask)
    assert all(np.array_equal(frames["none"], other) for other in frames.values())
    record(shop.clean, tmp_path / "other.nxs", replace(options, seed=10), Camera(), Illumination())
    with open_scan(tmp_path / "other.nxs") as file:
        assert not np.array_equal(file.frame(0), frames["none"][0])


def test_what_is_interrupted_leaves_nothing(shop, tmp_path):
    def stop(fraction: float) -> None:
        if fraction > 0.5:
            raise KeyboardInterrupt

    out, truth = tmp_path / "out.nxs", tmp_path / "truth.h5"
    for act in (
        lambda: record(shop.clean, out, RecordingOptions(flats=4, darks=2), QUIET, STEADY, truth, stop),
        lambda: correct(shop.raw, out, CorrectionOptions("plain"), stop),
        lambda: join((shop.clean, shop.clean), out, on_progress=stop),
    ):
        with pytest.raises(KeyboardInterrupt):
            act()
    assert list(tmp_path.iterdir()) == []


def test_a_scintillator_joins_the_point_spread_function(shop, tmp_path):
    record(
        shop.clean,
        tmp_path / "raw.nxs",
        RecordingOptions(flats=1, darks=1),
        replace(QUIET, scintillator_px=0.4),
        STEADY,
    )
    with open_scan(tmp_path / "raw.nxs") as file:
        assert file.exposures.psf_sigma_px == pytest.approx(np.full(4, 0.5))


def test_what_cannot_be_recorded(shop, tmp_path):
    options = RecordingOptions(flats=1, darks=1)
    with pytest.raises(InputError, match="it is raw already"):
        record(shop.raw, tmp_path / "again.nxs", options, QUIET, STEADY)
    noisy = Scan(np.ones((4, *SHAPE)), taken(), np.zeros(4, bool), {"photons_per_pixel": "100"})
    write_scan(tmp_path / "noisy.nxs", noisy)
    with pytest.raises(InputError, match="has the noise of 100 photons"):
        record(tmp_path / "noisy.nxs", tmp_path / "again.nxs", options, QUIET, STEADY)
    for name in ("flats", "darks"):
        with pytest.raises(InputError, match=f"{name} must be at least 1"):
            RecordingOptions(**{name: 0})
    with pytest.raises(InputError, match=r"clean\.nxs is read or written already"):
        record(shop.clean, shop.clean, options, QUIET, STEADY)
    with pytest.raises(InputError, match=r"raw\.nxs is read or written already"):
        record(shop.clean, tmp_path / "raw.nxs", options, QUIET, STEADY, tmp_path / "raw.nxs")
    with pytest.raises(InputError, match="flip must be one of"):
        RecordingOptions(flip="up")  # type: ignore[arg-type]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["noisy.nxs"]


# --- correcting


def test_steady_light_and_many_photons_give_the_scan_back(shop, tmp_path):
    options = RecordingOptions(photons_per_pixel=1e12, flats=4, darks=2, flip="rows")
    record(shop.clean, tmp_path / "raw.nxs", options, QUIET, STEADY)
    correct(tmp_path / "raw.nxs", tmp_path / "scan.nxs", CorrectionOptions("plain"))
    clean, found, read = (read_scan(p) for p in (shop.clean, tmp_path / "scan.nxs", tmp_path / "raw.nxs"))
    step = 1 / (0.4 * 65535)
    assert np.abs(found.frames - clean.frames).max() < 3 * step
    assert np.array_equal(read.frames, found.frames)
    assert np.array_equal(found.is_test, clean.is_test)
    assert np.array_equal(found.views.shifts, clean.views.shifts)
    assert found.provenance["corrected"] == "plain"


def test_the_dynamic_flat_field_leaves_less_than_a_third(shop, tmp_path):
    """Of the residual that plain flat-fielding leaves, photon noise and all, even if plain frames are normalised."""
    clean = read_scan(shop.clean).frames
    left = {}
    for name, options in {
        "plain": CorrectionOptions("plain"),
        "plain, normalised": CorrectionOptions("plain", "mean"),
        "dynamic": CorrectionOptions("dynamic"),
        "dynamic, rim": CorrectionOptions("dynamic", "rim"),
    }.items():
        done = correct(shop.raw, tmp_path / "scan.nxs", options)
        found = read_scan(tmp_path / "scan.nxs")
        left[name] = rms(found.frames - clean)
        if name.startswith("dynamic"):
            assert done.components == 6
            assert found.provenance["corrected"] == "dynamic, 6 components"
    assert left["dynamic"] < left["plain, normalised"] / 3 < left["plain"] / 3
    assert left["dynamic"] < 0.015  # photon noise is 0.01
    assert left["dynamic, rim"] < left["plain, normalised"] / 3


def test_defects_are_filled_marked_or_not(shop, tmp_path):
    with h5py.File(shop.truth) as file:
        defects = file["sensor/dead"][()] | file["sensor/hot"][()]
    assert 2 <= defects.sum() <= 20
    unmarked = tmp_path / "unmarked.nxs"
    unmarked.write_bytes(shop.raw.read_bytes())
    with h5py.File(unmarked, "a") as file:
        del file["/entry/instrument/detector/pixel_mask"]
    reports = [correct(path, tmp_path / "scan.nxs") for path in (shop.raw, unmarked)]
    assert (reports[0].marked, reports[0].found) == (defects.sum(), 0)
    assert (reports[1].marked, reports[1].found) == (0, defects.sum())
    frames, clean = read_scan(tmp_path / "scan.nxs").frames, read_scan(shop.clean).frames
    assert rms((frames - clean)[:, defects]) < 0.06
    with pytest.raises(InputError, match="`holosplat correct` repairs such pixels"):
        read_scan(unmarked)


def test_frames_are_read_one_by_one(shop, tmp_path, monkeypatch):
    """No read takes more than a frame, and flats are read in strips: the file may be larger than memory."""
    sizes = []
    whole = scan_file.ScanFile.rows

    def watched(self, number, rows):
        found = whole(self, number, rows)
        sizes.append(found.size)
        return found

    monkeypatch.setattr(scan_file.ScanFile, "rows", watched)
    monkeypatch.setattr(sys.modules["holosplat.preprocess.eigen_flats"], "ROWS", 16)
    correct(shop.raw, tmp_path / "strips.nxs")
    monkeypatch.undo()
    correct(shop.raw, tmp_path / "whole.nxs")
    assert max(sizes) == SHAPE[0] * SHAPE[1]
    assert sizes.count(16 * SHAPE[1]) == 2 * 60 * 4
    strips, once = (read_scan(tmp_path / name).frames for name in ("strips.nxs", "whole.nxs"))
    assert strips == pytest.approx(once, abs=1e-4)


def test_what_cannot_be_corrected(shop, tmp_path):
    out = tmp_path / "scan.nxs"
    with pytest.raises(InputError, match="at least three flats"):
        correct(shop.clean, out)
    with pytest.raises(InputError, match=r"must mark flats .1. in image_key, but it marks 0"):
        correct(shop.clean, out, CorrectionOptions("plain"))
    swapped = tmp_path / "swapped.nxs"
    swapped.write_bytes(shop.raw.read_bytes())
    with h5py.File(swapped, "a") as file:
        file["/entry/instrument/detector/image_key"][:70] = [FLAT] * 10 + [DARK] * 60
    with pytest.raises(InputError, match="of the pixels are defective by its darks and flats"):
        correct(swapped, out)
    dark = tmp_path / "dark.nxs"
    dark.write_bytes(shop.raw.read_bytes())
    with h5py.File(dark, "a") as file:
        file["/entry/instrument/detector/data"][-1] = 0
    with pytest.raises(InputError, match="frame 73 is as dark as the dark ones"):
        correct(dark, out)
    with pytest.raises(InputError, match=r"raw\.nxs is read or written already"):
        correct(shop.raw, shop.raw)
    with pytest.raises(InputError, match="components goes with the method dynamic"):
        CorrectionOptions("plain", components=3)
    with pytest.raises(InputError, match="binning must be at least 1"):
        CorrectionOptions(binning=0)
    with pytest.raises(InputError, match="normalise must be"):
        CorrectionOptions(normalise="max")  # type: ignore[arg-type]
    assert not out.exists()


# --- joining


def test_resampled_frames_are_those_of_the_coarser_pixel():
    """Against simulations on the other raster: by 1.6, and by 2 exactly; blurred, so that pixels resolve all."""
    scene = cells()
    fine = simulate(scene, taken((100, 120), 2e-6, 1.5), oversample=4).frames
    for shape, pixel in (((60, 72), 3.2e-6), ((50, 60), 4e-6)):
        wanted = simulate(scene, taken(shape, pixel, 1.5 * 2e-6 / pixel), oversample=6).frames
        found = np.stack([Resampling((100, 120), 2e-6, shape, pixel)(frame) for frame in fine])
        inside = (slice(None), slice(3, -3), slice(3, -3))
        assert rms((found - wanted)[inside]) < 0.01 * wanted.std()


def test_resampling_keeps_even_light_and_tells_its_blur():
    down = Resampling((20, 31), 2e-6, (9, 14), 4.3e-6)
    assert down(np.full((20, 31), 1.7)) == pytest.approx(np.full((9, 14), 1.7))
    assert down.extra_blur == 0
    up = Resampling((20, 31), 2e-6, (40, 62), 1e-6)
    assert up.extra_blur == pytest.approx(1e-6 * 0.5)
    x = np.arange(31) + 0.5
    wave = np.cos(np.pi * 4 * x / 31)[None] * np.ones((20, 1))
    assert up(wave)[7] == pytest.approx(np.cos(np.pi * 4 * (np.arange(62) + 0.5) / 62))
    same = Resampling((20, 31), 2e-6, (20, 31), 2e-6)
    noise = np.random.default_rng(0).normal(size=(20, 31))
    assert same(noise) == pytest.approx(noise)


def beams(folder: Path) -> tuple[Path, Path]:
    """Two files of the same cells: other pixels, fields, distances and points of view; the second is reversed."""
    a = simulate(cells(), taken(psf=0.9), oversample=4)
    tilted = replace(taken((80, 96), 2.5e-6, 1.2, 2), distance=np.full(2, 0.15))
    b = simulate(cells(), tilted, oversample=4, is_test=np.array([True, False]))
    paths = folder / "a.nxs", folder / "b.nxs"
    write_scan(paths[0], a)
    write_scan(paths[1], replace(b, frames=b.frames[:, :, ::-1]))
    return paths


def test_beams_are_joined_on_the_coarsest_pixels_of_the_common_field(tmp_path):
    paths = beams(tmp_path)
    join(paths, tmp_path / "scan.nxs", flips=("none", "columns"))
    found = read_scan(tmp_path / "scan.nxs")
    assert (found.views.shape, found.views.pixel_size) == ((62, 75), PIXEL)
    assert found.exposures.distance.tolist() == [0.1] * 4 + [0.15] * 2
    assert found.exposures.psf_sigma_px == pytest.approx([0.9] * 4 + [1.2 * 2.5 / 3.2] * 2)
    assert found.is_test.tolist() == [False, False, False, True, True, False]
    assert found.exposures.time == pytest.approx([0, 1e-6, 2e-6, 3e-6, 0, 1e-6])
    wanted = simulate(cells(), found.exposures, oversample=6).frames
    inside = (slice(None), slice(4, -4), slice(4, -4))
    for part in (slice(0, 4), slice(4, 6)):
        assert rms((found.frames - wanted)[part][inside]) < 0.02 * wanted.std()


def test_a_finer_raster_keeps_the_coarse_pixels_blur(tmp_path):
    paths = beams(tmp_path)
    join(paths, tmp_path / "scan.nxs", 2e-6, ("none", "columns"))
    found = read_scan(tmp_path / "scan.nxs")
    extra = np.sqrt((PIXEL**2 - 4e-12) / 12) / 2e-6
    assert found.exposures.psf_sigma_px[0] == pytest.approx(np.hypot(0.9 * 1.6, extra))
    wanted = simulate(cells(), found.exposures, oversample=4).frames
    inside = (slice(None), slice(6, -6), slice(6, -6))
    assert rms((found.frames - wanted)[:4][inside]) < 0.08 * wanted.std()


def test_what_cannot_be_joined(tmp_path):
    paths = beams(tmp_path)
    other = tmp_path / "other.nxs"
    exposures = replace(taken(), energy_kev=17.0)
    write_scan(other, Scan(np.ones((4, *SHAPE)), exposures, np.zeros(4, bool)))
    out = tmp_path / "scan.nxs"
    with pytest.raises(InputError, match=r"other\.nxs has 17 keV, but .*a\.nxs has 20 keV: a scan has one energy"):
        join((paths[0], other), out)
    with pytest.raises(InputError, match=r"a\.nxs is read or written already"):
        join(paths, paths[0])
    with pytest.raises(InputError, match="needs at least two"):
        join(paths[:1], out)
    with pytest.raises(InputError, match=r"--flip must say one of .* for each of the 2 files, but it says 1"):
        join(paths, out, flips=("none",))
    with pytest.raises(InputError, match=r"would be .* pixels"):
        join(paths, out, 1e-4)
    with pytest.raises(InputError, match="--pixel-size must lie between"):
        join(paths, out, 3.2)
    assert not out.exists()


# --- spectra


def test_a_spectrum_is_the_incoherent_sum_of_its_energies():
    filling, light = Filling(), Spectrum(np.array([18.0, 22.0]), np.array([1.0, 3.0]))
    exposures = taken(count=2)
    found = np.stack(
        list(polychromatic_frames(lambda e: refilled(cells(), filling, e), light, exposures, Simulation(oversample=3)))
    )
    wanted = 0.0
    for energy, weight in ((18.0, 0.25), (22.0, 0.75)):
        scene = MeshScene.of_one_material(cells().meshes, HAEMOGLOBIN.delta_beta(energy))
        wanted = wanted + weight * simulate(scene, replace(exposures, energy_kev=energy), oversample=3).frames
    assert found == pytest.approx(wanted, abs=1e-6)
    noisy = Simulation(50.0, 1, 3)
    drawn = np.stack(list(polychromatic_frames(lambda e: refilled(cells(), filling, e), light, exposures, noisy)))
    assert np.allclose(drawn * 50, np.rint(drawn * 50), atol=1e-4)
    assert (drawn - found).std() == pytest.approx(np.sqrt(1 / 50), rel=0.05)


def test_a_moving_series_is_refilled_too():
    series = MeshSeries((cells(), cells().moved(np.ones(3) * 1e-6)), np.array([0.0, 1.0]))
    filled = refilled(series, Filling(), 10.0)
    assert isinstance(filled, MeshSeries)
    assert all(m == HAEMOGLOBIN.delta_beta(10.0) for scene in filled.snapshots for m in scene.materials)


def test_spectrum_files(tmp_path):
    path = tmp_path / "spectrum.txt"
    path.write_text("# keV weight\n9.0 1\n9.1 3\n")
    assert read_spectrum(path).weights.tolist() == [0.25, 0.75]
    for text in ("9.0 1 2\n", "nine one\n", "9.0\n"):
        path.write_text(text)
        with pytest.raises(InputError, match="two columns of numbers"):
            read_spectrum(path)
    with pytest.raises(InputError, match="does not exist"):
        read_spectrum(tmp_path / "none.txt")


# --- the command line


def holosplat(*arguments: object) -> tuple[int, str]:
    """Exit code and standard error of a command."""
    err, before = io.StringIO(), sys.argv
    sys.argv = ["holosplat", *map(str, arguments)]
    try:
        with contextlib.redirect_stderr(err):
            main()
    except SystemExit as end:
        return int(end.code or 0), err.getvalue()
    finally:
        sys.argv = before
    return 0, err.getvalue()


def test_the_commands_do_what_they_say(shop, tmp_path):
    raw, out, truth = tmp_path / "raw.nxs", tmp_path / "scan.nxs", tmp_path / "truth.h5"
    code, said = holosplat(
        "record", shop.clean, "--out", raw, "--truth", truth, "--bits", 10, "--gain", 0.2, "--flats", 20, "--seed", 2
    )
    assert code == 0, said
    assert "4 projections, 20 flats and 20 darks, 10 bits, 0.2 counts a photon" in said
    assert "saturated; lower --gain" in said
    code, said = holosplat("record", shop.clean, "--out", raw, "--flats", 20, "--components", 3)
    assert code == 0, said
    assert "warning" not in said
    code, said = holosplat("correct", raw, "--out", out, "--method", "dynamic")
    assert code == 0, said
    assert "4 frames by flat fields of 5 components, normalised: mean" in said
    assert "marked in the file, 0 found beside" in said
    code, said = holosplat("join", shop.clean, out, "--out", tmp_path / "both.nxs", "--flip", "none", "none")
    assert code == 0, said
    assert "8 frames of 65 × 80 pixels of 3.2 µm" in said
    assert len(read_scan(tmp_path / "both.nxs")) == 8
    code, said = holosplat("correct", shop.clean, "--out", out)
    assert code == 2
    assert said.startswith("holosplat: ") and said.count("\n") == 1  # noqa: PT018


def test_the_source_in_simulate(tmp_path):
    mesh, out = tmp_path / "cell.vtk", tmp_path / "scan.nxs"
    write_mesh(mesh, cells().meshes[0], "um")
    beam = ["simulate", mesh, "--detector", 32, 40, "--views", 2, "--test-every", 0, "--out", out]
    code, said = holosplat(
        *beam, "--source-distance", 0.3, "--cone", "--distance", 0.45, "--pixel-size", 8e-6, "--source-size", 4e-6,
        "--psf-sigma-px", 0.3, "--bandwidth", 0.01, "--energies", 2,
    )  # fmt: skip
    assert code == 0, said
    found = read_scan(out)
    assert found.views.pixel_size == pytest.approx(3.2e-6)
    assert found.exposures.distance == pytest.approx(np.full(2, 0.18))
    assert found.exposures.psf_sigma_px == pytest.approx(np.hypot(0.3, 4e-6 * 0.18 / 0.3 / 3.2e-6))
    assert found.provenance["bandwidth"] == "0.01"
    for wrong, message in (
        (["--cone"], "--cone needs --source-distance"),
        (["--source-size", 1e-6], "--source-size needs --source-distance"),
        (["--source-distance", 1.0], "changes nothing"),
        (["--bandwidth", 0.9], "bandwidth must lie between"),
    ):
        code, said = holosplat(*beam, *wrong)
        assert (code, message in said) == (2, True), said
