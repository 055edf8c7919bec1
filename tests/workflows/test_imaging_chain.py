"""From a noise-free scan to raw counts and back: `record`, `correct`, and their commands."""

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
from helpers.imaging import SHAPE, cells, rms, taken
from holosplat.beamline.record import RecordingOptions, record
from holosplat.beamline.simulate import simulate
from holosplat.checks import InputError
from holosplat.cli import main
from holosplat.io.nxtomo import read_scan, write_scan
from holosplat.io.raw_file import DARK, FLAT, PROJECTION
from holosplat.io.scan_file import open_scan
from holosplat.io.vtk import write_mesh
from holosplat.optics.camera import Camera, Illumination
from holosplat.scan import Scan
from holosplat.workflows.correct import CorrectionOptions, correct
from holosplat.workflows.join import join

STEADY = Illumination(0.0, structure=0.0, variation=0.0, components=0, pointing=0.0, beam_width=1e3)
QUIET = Camera(16, read_noise=0.0, gain_spread=0.0, offset_spread=0.0, dead=0.0, hot=0.0)


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
        "plain": CorrectionOptions("plain", "none"),
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
        dead = file["sensor/dead"][()]
        defects = dead | file["sensor/hot"][()]
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
    missing = read_scan(unmarked).missing
    assert missing is not None
    assert missing[:, dead].all()  # without light no value, and no weight; what is hot has one


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
        correct(shop.clean, out, CorrectionOptions("dynamic"))
    with pytest.raises(InputError, match="must hold flats"):
        correct(shop.clean, out)
    with pytest.raises(InputError, match=r"must hold flats .image_key 1., but it holds none; add --flats"):
        correct(shop.clean, out, CorrectionOptions("plain"))
    swapped = tmp_path / "swapped.nxs"
    swapped.write_bytes(shop.raw.read_bytes())
    with h5py.File(swapped, "a") as file:
        file["/entry/instrument/detector/image_key"][:70] = [FLAT] * 10 + [DARK] * 60
    with pytest.raises(InputError, match=r"no flats, but frame 10, .* and 55 more differ; check image_key"):
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
    code, said = holosplat("record", shop.clean, "--out", raw, "--flats", 20, "--components", 3, "--force")
    assert code == 0, said
    assert "warning" not in said
    code, said = holosplat("correct", raw, "--out", out, "--method", "dynamic")
    assert code == 0, said
    assert "4 frames by flat fields of 5 components, normalised: air" in said
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
        code, said = holosplat(*beam, *wrong, "--force")
        assert (code, message in said) == (2, True), said
