"""`simulate` of moving meshes, known geometries and misaligned beamlines, and `reconstruct` of one time of a series."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from helpers.cli import FORMULA, QUICK, everything_in, holosplat, refused, worked
from holosplat.beamline.simulate import Filling, read_scene, simulate
from holosplat.geometry import Views, rotation_tilted
from holosplat.io.nxtomo import read_scan
from holosplat.io.volumes import read_volume
from holosplat.io.vtk import write_mesh
from holosplat.materials import Compound
from holosplat.mesh import TriangleMesh
from holosplat.specimens.red_cells import icosphere
from holosplat.tables import to_table

pytestmark = pytest.mark.usefixtures("unjudged_runs")

PIXEL = 1e-6
BEAM = ["--material", FORMULA, "--density", "1.335", "--pixel-size", "1e-6", "--detector", "21", "34"]
STEP = 2e-6
"""Seconds between snapshots, in which the balls move by 3 µm along x."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Four snapshots of two balls of 4 µm radius that move along x, and a collection of them."""
    path = tmp_path_factory.mktemp("series")
    vertices, faces = icosphere(2)
    entries = ""
    for n in range(4):
        for name, y in (("b0", -5.0), ("b1", 5.0)):
            mesh = TriangleMesh(1e-6 * (4 * vertices + np.array([3 * n, y, 0])), faces, f"{name} t={2 * n}us")
            write_mesh(path / f"{name}_{n}.vtk", mesh, "um")
            entries += f'<DataSet timestep="{2 * n}" file="{name}_{n}.vtk"/>'
    (path / "all.pvd").write_text(f'<VTKFile type="Collection"><Collection>{entries}</Collection></VTKFile>')
    return path


def middle(frame: np.ndarray) -> float:
    """Where the shadows are along x [µm]."""
    columns = np.arange(frame.shape[1]) + 0.5 - frame.shape[1] / 2
    weight = ((frame - 1.0) ** 2).sum(0)
    return float((columns * weight).sum() / weight.sum())


def test_a_series_becomes_frames_by_views_and_volumes_by_time(folder, tmp_path):
    """At 1 MHz: seven times, at each of which the balls, whose sweep is centred, are 1.5 µm further."""
    options = ["--frame-rate", 1e6, "--angles-deg", 0, 180, "--tilts-deg", 0, 0, "--test-every", 2]
    truths = ["--truth", tmp_path / "t.h5", "--truth-frames", 0, 5]
    outcome = worked(holosplat("simulate", folder, *BEAM, *options, "--out", tmp_path / "s.nxs", *truths))
    assert "at 7 times from 2 views" in outcome.err
    scan = read_scan(tmp_path / "s.nxs")
    np.testing.assert_allclose(scan.exposures.time, np.repeat(np.arange(7) * 1e-6, 2), atol=1e-18)
    assert scan.is_test.tolist() == [False, True] * 7
    for n in range(7):
        wanted = -4.5 + 1.5 * n
        np.testing.assert_allclose([middle(f) for f in scan.at_instant(n).frames], [wanted, -wanted], atol=0.1)
    for n in (0, 5):
        volume = read_volume(tmp_path / f"t_t{n:04d}.h5")
        x = volume.grid.axes()[0]
        assert (volume.delta.sum((0, 1)) * x).sum() / volume.delta.sum() == pytest.approx(
            1e-6 * (-4.5 + 1.5 * n), abs=1e-8
        )
    assert {p.name for p in tmp_path.iterdir()} == {"s.nxs", "t_t0000.h5", "t_t0005.h5"}
    assert scan.provenance["snapshots"] == "4"


def test_a_collection_is_the_same_series(folder, tmp_path):
    """Times may be held out with all their views; motion is blurred if asked for."""
    options = ["--geometry", "xmpi_2beam", "--frames", 3, "--hold-out", "times", "--test-every", 3]
    frames = []
    for name, source, extra in (
        ("a", folder, []),
        ("b", folder / "all.pvd", []),
        ("c", folder, ["--start", 1e-6, "--exposure", 2e-6, "--pulses", 4]),
    ):
        out = ["--frame-rate", 1e6, "--out", tmp_path / f"{name}.nxs"]
        worked(holosplat("simulate", source, *BEAM, *options, *extra, *out))
        scan = read_scan(tmp_path / f"{name}.nxs")
        frames.append(scan.frames)
        assert scan.is_test.tolist() == [False] * 4 + [True] * 2
        assert scan.exposures.time[0] == 0
    np.testing.assert_array_equal(frames[0], frames[1])
    assert scan.provenance["pulses"] == "4"
    assert np.abs(frames[2] - 1).max() < np.abs(frames[0] - 1).max()  # what is smeared is fainter


def test_one_time_of_a_series_is_reconstructed_and_judged(folder, tmp_path, monkeypatch):
    """Without its report, which takes seconds to draw."""
    monkeypatch.setattr("holosplat.cli.scans.report_run", lambda *what: tmp_path / "run/report.html")
    options = ["--frame-rate", 5e5, "--views", 4, "--truth-frames", 2, "--truth", tmp_path / "t.h5"]
    worked(holosplat("simulate", folder, *BEAM, *options, "--out", tmp_path / "s.nxs"))
    (tmp_path / "quick.json").write_text(json.dumps(to_table(QUICK)))
    known = ["--material", "haemoglobin", "--config", tmp_path / "quick.json"]
    before = everything_in(tmp_path)
    refused(
        holosplat("reconstruct", tmp_path / "s.nxs", "--out", tmp_path / "run", *known),
        "of 4, from 0 to 6e-06 s",
        "--time-frame 0 … 3",
        "--motion flow",
    )
    refused(
        holosplat("reconstruct", tmp_path / "s.nxs", "--out", tmp_path / "run", *known, "--time-frame", 4),
        "from 0 to 3, but 4",
    )
    for words in (["series", "plan"], ["reconstruct", "--motion", "each"], ["reconstruct", "--time-frame", 1]):
        impossible = ["--material", "haemoglobin", "--method", "volume", "--matter", "levels"]
        refused(holosplat(*words, tmp_path / "s.nxs", "--out", tmp_path / "run", *impossible), "volume has no levels")
    assert everything_in(tmp_path) == before
    worked(holosplat("reconstruct", tmp_path / "s.nxs", "--out", tmp_path / "run", *known, "--time-frame", 2))
    scored = json.loads(
        worked(holosplat("evaluate", tmp_path / "run", "--truth", tmp_path / "t_t0002.h5", "--json")).out
    )
    assert scored["dice"] > 0.5
    worked(holosplat("render", tmp_path / "run", "--scan", tmp_path / "s.nxs", "--out", tmp_path / "p.nxs"))
    assert len(read_scan(tmp_path / "p.nxs")) == 1  # the held-out view of that time
    every = holosplat("reconstruct", tmp_path / "s.nxs", "--out", tmp_path / "all", *known, "--time-frame", "all")
    worked(every)
    mixed = json.loads(
        worked(holosplat("evaluate", tmp_path / "all", "--truth", tmp_path / "t_t0002.h5", "--json")).out
    )
    assert mixed["dice"] < scored["dice"]


def test_tilted_and_known_geometries(folder, tmp_path):
    balls = sorted(folder.glob("*_0.vtk"))
    for options, wanted in (
        (["--geometry", "xmpi_3beam"], rotation_tilted([0, 30, 48], [0, 0, 0])),
        (["--angles-deg", 0, "-30", "--tilts-deg", "5", "-1e1"], rotation_tilted([0, -30], [5, -10])),
    ):
        worked(holosplat("simulate", *balls, *BEAM, *options, "--out", tmp_path / "s.nxs", "--force"))
        np.testing.assert_allclose(read_scan(tmp_path / "s.nxs").views.rotations, wanted, atol=1e-12)


def test_misaligned_frames_tell_nominal_poses_and_the_true_ones_are_kept_apart(folder, tmp_path):
    balls = sorted(folder.glob("*_0.vtk"))
    errors = ["--misalign-shift", 2, "--misalign-rotation", 0.5, "--misalign-distance", 0.02, "--misalign-seed", 3]
    out = ["--out", tmp_path / "s.nxs", "--true-exposures", tmp_path / "true.nxs"]
    worked(holosplat("simulate", *balls, *BEAM, "--views", 3, *errors, *out))
    worked(holosplat("simulate", *balls, *BEAM, "--views", 3, "--out", tmp_path / "aligned.nxs"))
    told, true, aligned = (read_scan(tmp_path / f"{name}.nxs") for name in ("s", "true", "aligned"))
    nominal = Views.evenly_spaced(3, (21, 34), PIXEL)
    np.testing.assert_allclose(told.views.rotations, nominal.rotations, atol=1e-12)
    assert not told.views.shifts.any()
    assert set(told.exposures.distance) == {0.1}
    assert not np.allclose(told.frames, aligned.frames, atol=1e-2)
    np.testing.assert_array_equal(told.frames, true.frames)
    assert np.abs(true.views.shifts).max() > PIXEL
    assert 0 < np.abs(true.exposures.distance - 0.1).max() < 0.01
    # The frames are those of the true exposures, and nothing in the scan file gives them away.
    again = simulate(read_scene(balls, Filling(Compound(FORMULA, 1.335)), 20.0), true.exposures)
    np.testing.assert_allclose(again.frames, told.frames, atol=1e-6)
    assert told.provenance == aligned.provenance
    assert true.provenance["misalign_shift"] == "2"


BAD_SERIES: dict[str, tuple[list[object], list[str]]] = {
    "no rate": (["--frames", 3], ["--frames needs --frame-rate"]),
    "blur without a rate": (["--exposure", 1e-6, "--pulses", 3], ["--exposure needs --frame-rate"]),
    "a box without a rate": (["--period", 80, 0, 0], ["--period goes with --frame-rate"]),
    "a rate of nothing": (["--frame-rate", 0], ["--frame-rate", "positive"]),
    "too many frames": (["--frame-rate", 1e6, "--frames", 8], ["room for 7 frames", "8 are asked"]),
    "exposure alone": (["--frame-rate", 1e6, "--exposure", 1e-6], ["exposure", "pulses", "both"]),
    "blur beyond the start": (
        ["--frame-rate", 1e6, "--start", 0, "--exposure", 2e-6, "--pulses", 2],
        ["start must be at least 5e-07 s"],
    ),
    "a truth of no time": (["--frame-rate", 1e6, "--truth", "t.h5", "--truth-frames", 7], ["0 to 6", "7"]),
    "times without a truth": (["--frame-rate", 1e6, "--truth-frames", 0], ["--truth-frames needs --truth"]),
    "one file twice": (["--frame-rate", 1e6, "--truth", "s.nxs"], ["must be different places"]),
    "a negative box": (["--frame-rate", 1e6, "--period", -80, 0, 0], ["period", "negative"]),
    "a unit for no collection": (["--frame-rate", 1e6, "--time-unit", "us"], ["time unit", ".pvd"]),
    "shifts of no size": (["--misalign-shift", -1], ["--misalign-shift", "-1"]),
    "distances that are none": (["--misalign-distance", 2], ["--misalign-distance", "at most 1", "2"]),
    "a tilt too many": (["--tilts-deg", 1, 2], ["--tilts-deg needs --angles-deg"]),
}


@pytest.mark.parametrize("fault", BAD_SERIES)
def test_bad_series_are_refused_and_leave_nothing(folder, tmp_path, monkeypatch, fault):
    options, words = BAD_SERIES[fault]
    monkeypatch.chdir(tmp_path)
    refused(holosplat("simulate", folder, *BEAM, "--views", 2, "--out", "s.nxs", *options), *words)
    assert list(tmp_path.iterdir()) == []


def test_snapshots_taken_for_one_scene_are_a_warning(folder, tmp_path):
    for source, count in ((folder, 4), (folder / "b0_1.vtk", 1)):
        outcome = worked(holosplat("simulate", source, *BEAM, "--views", 1, "--out", tmp_path / "s.nxs", "--force"))
        assert (f"warning: the files seem to be {count} snapshots" in outcome.err) == (count > 1)
        assert ("--frame-rate" in outcome.err) == (count > 1)


def test_a_collection_needs_a_frame_rate(folder, tmp_path):
    outcome = holosplat("simulate", folder / "all.pvd", *BEAM, "--views", 2, "--out", tmp_path / "s.nxs")
    refused(outcome, "all.pvd", "--frame-rate")
