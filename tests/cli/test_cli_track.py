"""`track` on the command line, and every command that reads its runs."""

from __future__ import annotations

import csv
import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from helpers.cli import Outcome, holosplat, refused, worked
from helpers.moving_ellipsoids import PIXEL, STEP, TIMES, scan, truth
from helpers.pictures import undrawn
from holosplat.geometry import Grid
from holosplat.io.nxtomo import read_scan, write_scan
from holosplat.io.objects import read_object
from holosplat.io.paraview import read_pvd
from holosplat.io.volumes import read_volume, write_voxels
from holosplat.io.vtk import read_meshes
from holosplat.representations import MovingSurfaces

KNOWN = ("--material", "haemoglobin", "--medium", "air")


def worked_by(*arguments: object) -> Outcome:
    return worked(holosplat(*arguments))


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """The scan, the truth at the last time, and a run of few steps."""
    folder = tmp_path_factory.mktemp("track")
    write_scan(folder / "scan.nxs", scan())
    write_voxels(folder / "truth.h5", truth().at(STEP * (TIMES - 1)), Grid.of_views(scan().views))
    how = (*KNOWN, "--effort", "0.2", "--pieces", "1", "--rounds", "0")
    with undrawn():
        said = worked_by("track", folder / "scan.nxs", *how, "--out", folder / "run")
    assert "start: bodies at single times: tomography (frames of one time: network's guess -" in said.out
    assert "against air: δ and β are differences" in said.out
    return folder


def test_a_run_has_its_bodies_and_tracks(folder):
    """The collection names a file a body and time; rows of the table are those of these files."""
    run = folder / "run"
    found = read_object(run / "object.h5")
    assert isinstance(found, MovingSurfaces)
    assert found.count == 3
    steps = read_pvd(run / "bodies.pvd")
    assert [step.time for step in steps] == pytest.approx(STEP * np.arange(TIMES))
    with (run / "tracks.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(row["time_s"], row["body"]) for row in rows[:3]] == [("0", str(k)) for k in range(3)]
    assert len(rows) == 3 * TIMES
    for mesh, row in zip(read_meshes(steps[-1].files, "um"), rows[-3:]):
        assert mesh.volume == pytest.approx(float(row["volume_m3"]), rel=1e-4)
    summary = json.loads((run / "summary.json").read_text())
    assert summary["times_s"] == pytest.approx(STEP * np.arange(TIMES))
    assert summary["kind"] == "moving-surfaces"
    assert summary["decided"]["begun"].startswith("bodies at single times: tomography (")
    with (run / "times.csv").open() as file:
        times = list(csv.DictReader(file))
    assert [float(row["time_s"]) for row in times] == pytest.approx(STEP * np.arange(TIMES))
    assert all(row["verdict"] and row["explained"] in {"0", "1"} for row in times)
    page = (run / "report.html").read_text(encoding="utf-8")
    assert f"of {TIMES} times are " in page


def test_rows_have_standard_errors(folder):
    """Of half a pixel at most, for bodies in the field; the report has them, too."""
    with (folder / "run" / "tracks.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert "se_nx" not in rows[0]
    middle = rows[3 * (TIMES // 2)]
    for axis in "xyz":
        assert 1e-4 * PIXEL < float(middle[f"se_{axis}_m"]) < 0.5 * PIXEL
    assert 0 < float(middle["se_volume_m3"]) < 0.2 * float(middle["volume_m3"])
    page = (folder / "run" / "report.html").read_text(encoding="utf-8")
    assert "Bands are standard errors" in page
    assert " ± " in page


def test_a_run_that_was_cut_off_goes_on(folder, tmp_path):
    """Here after its fits, before anything was written: with what it was begun with, and nothing else."""
    cut, how = tmp_path / "run", (*KNOWN, "--effort", "0.2", "--pieces", "1", "--rounds", "0")
    shutil.copytree(folder / "run", cut)
    for name in ("tracks.csv", "object.h5", "summary.json", "report.html"):
        (cut / name).unlink()
    refused(holosplat("evaluate", cut), "finish it with --resume")
    again = ("track", folder / "scan.nxs", *how, "--out", cut)
    refused(holosplat(*again), "--resume")
    refused(holosplat(*again, "--resume", "--volume-kept", "0.1"), "method", "use the same, or another --out")
    refused(holosplat(*again, "--resume", "--views", "0:16"), "scan file", "use the same, or another --out")
    worked_by(*again, "--resume")
    for name in ("tracks.csv", "bodies.pvd", "metrics.csv"):
        assert (cut / name).read_bytes() == (folder / "run" / name).read_bytes()
    assert (cut / "report.html").is_file()


def test_it_is_scored_at_one_time(folder):
    whole = worked_by("evaluate", folder / "run", "--truth", folder / "truth.h5", "--json")
    last = worked_by("evaluate", folder / "run", "--truth", folder / "truth.h5", "--time-frame", TIMES - 1, "--json")
    first, right = (json.loads(said.out)["volume"]["dice"] for said in (whole, last))
    assert right > 0.88 > first + 0.2  # without a time it is the first one's matter
    refused(holosplat("evaluate", folder / "run", "--time-frame", TIMES), f"0 to {TIMES - 1}", str(TIMES))


def test_frames_of_all_times_are_rendered(folder):
    worked_by("render", folder / "run", "--scan", folder / "scan.nxs", "--split", "train", "--out", folder / "said.nxs")
    said, wanted = read_scan(folder / "said.nxs").frames, scan().frames
    assert np.abs(said - wanted).mean() < 0.6 * np.abs(wanted - 1).mean()


def test_volumes_and_bodies_are_exported_at_times(folder):
    """The same body has the same name at all times."""
    worked_by("export", folder / "run", "--volume", folder / "v.h5", "--bodies", folder / "b", "--time-frame", "all")
    found = read_object(folder / "run" / "object.h5")
    assert isinstance(found, MovingSurfaces)
    for k in range(TIMES):
        volume = read_volume(folder / f"v_t{k:04d}.h5")
        wanted = sum(mesh.volume for mesh in found.bodies(k * STEP))
        inside = volume.delta.sum() * PIXEL**3 / found.matter.delta
        assert inside == pytest.approx(wanted, rel=0.25)  # one body leaves the field
        files = sorted((folder / f"b_t{k:04d}").glob("body*.vtk"))
        for mesh, own in zip(read_meshes(files, "um"), found.bodies(k * STEP)):
            assert mesh.vertices == pytest.approx(own.vertices, abs=1e-3 * PIXEL)
    worked_by("export", folder / "run", "--volume", folder / "one.h5", "--time-frame", 3)
    assert np.array_equal(read_volume(folder / "one.h5").delta, read_volume(folder / "v_t0003.h5").delta)


def test_all_times_open_in_paraview(folder):
    """Beside HDF5 lies a .xdmf, beside .vti and .vtu a .pvd, which name them; bodies come back, and are simulated."""
    out = folder / "paraview"
    out.mkdir()
    command = ["export", folder / "run", "--shape", 6, 5, 7, "--time-frame", "all"]
    worked_by(*command, "--volume", out / "v.h5", "--bodies", out / "b.vtu")
    worked_by(*command, "--volume", out / "v.vti")
    found, times = read_object(folder / "run" / "object.h5"), [k * STEP for k in range(TIMES)]
    assert isinstance(found, MovingSurfaces)
    lines = (out / "v.xdmf").read_text(encoding="utf-8")
    assert [float(time) for time in re.findall(r'<Time Value="(.*?)"/>', lines)] == pytest.approx(times)
    assert re.findall(r">(v_t\d+\.h5):/beta<", lines) == [f"v_t{k:04d}.h5" for k in range(TIMES)]
    for name in ("v", "b"):
        steps = read_pvd(out / f"{name}.pvd")
        assert [step.time for step in steps] == pytest.approx(times)
    for step, time in zip(read_pvd(out / "b.pvd"), times):
        for mesh, own in zip(read_meshes(step.files, "um"), found.bodies(time), strict=True):
            assert mesh.name == own.name
            assert mesh.vertices == pytest.approx(own.vertices, abs=1e-3 * PIXEL)
    refused(holosplat(*command, "--volume", out / "w.vti", "--bodies", out / "w.vtu"), "would share", "w.pvd")
    (out / "v_t0001.vti").unlink()
    before = sorted(out.iterdir())
    refused(holosplat(*command, "--volume", out / "v.vti"), "v_t0000.vti must be new or empty")
    (out / "v_t0000.vti").unlink()
    refused(holosplat(*command, "--volume", out / "v.vti"), f"v_t000{2 if TIMES > 2 else 0}.vti must be new or empty")
    assert sorted(out.iterdir()) == [path for path in before if path.name != "v_t0000.vti"]
    simulated = ["--frame-rate", 1 / STEP, "--detector", 10, 12, "--pixel-size", PIXEL, "--views", 2]
    worked_by("simulate", out / "b.pvd", *simulated, "--out", out / "s.nxs")


def test_folders_of_all_times_are_replaced_by_force_alone(folder):
    out = folder / "times"
    out.mkdir()
    command = ["export", folder / "run", "--time-frame", "all", "--bodies", out / "b"]
    worked_by(*command)
    before = {path.name: sorted(one.name for one in path.iterdir()) for path in out.iterdir() if path.is_dir()}
    (out / "b_t0000" / "mine.txt").write_text("of another time")
    refused(holosplat(*command), "b_t0000 must be new or empty", "--force")
    worked_by(*command, "--force")
    after = {path.name: sorted(one.name for one in path.iterdir()) for path in out.iterdir() if path.is_dir()}
    assert after == before
    assert len(after) == TIMES
    (out / "b_t0000" / "provenance.json").unlink()
    refused(holosplat(*command, "--force"), "--force replaces folders that holosplat made", "b_t0000")


def test_bodies_move_in_one_file_for_viewers(folder):
    """A .glb of all times is a film, of one time a body as it is, and .stl a file a time."""
    worked_by("export", folder / "run", "--bodies", folder / "all.glb", "--time-frame", "all")
    worked_by("export", folder / "run", "--bodies", folder / "one.glb", "--time-frame", 1)
    assert (b'"animations"' in (folder / "all.glb").read_bytes(), (folder / "one.glb").stat().st_size > 1000) == (
        True,
        True,
    )
    assert b'"animations"' not in (folder / "one.glb").read_bytes()
    worked_by("export", folder / "run", "--bodies", folder / "b.stl", "--time-frame", "all")
    (mesh,) = read_meshes(folder / f"b_t{TIMES - 1:04d}.stl", "um")
    wanted = sum(body.volume for body in read_object(folder / "run" / "object.h5").bodies((TIMES - 1) * STEP))
    assert mesh.volume == pytest.approx(wanted, rel=1e-4, abs=0)


def test_what_cannot_be_followed_is_refused(folder):
    scan_file, out = folder / "scan.nxs", folder / "none"
    known = (*KNOWN, "--out", out)
    refused(holosplat("track", scan_file, *known, "--time-frame", "0"), "--time-frame", "leave it")
    refused(holosplat("track", scan_file, *known, "--effort", "0"), "--effort")
    refused(holosplat("track", scan_file, *known, "--degree", "0"), "degree")
    refused(holosplat("track", scan_file, *known[:2], "--out", folder / "run"), "run")
    refused(holosplat("track", scan_file, *known, "--views", "0:4"), "two times or more", "reconstruct")
    assert not out.exists()


def test_surfaces_of_bodies_in_motion_are_fitted_at_one_time(folder):
    """From those of the run, whose names they keep, to the frames of that time, which they explain about as well: the
    prior of shapes counts for more beside the frames of one time than beside those of all."""
    again = ("surface", folder / "run", "--out", folder / "again")
    refused(holosplat(*again), "at one time", f"0 … {TIMES - 1}", "export")
    refused(holosplat(*again, "--time-frame", TIMES), f"0 to {TIMES - 1}")
    assert not (folder / "again").exists()
    steps = ("--steps", "20")
    worked_by(*again, "--time-frame", TIMES - 1, *steps)
    found = read_object(folder / "run" / "object.h5")
    assert isinstance(found, MovingSurfaces)
    for k, own in enumerate(found.bodies((TIMES - 1) * STEP)):
        (mesh,) = read_meshes([folder / "again" / f"body{k:03d}.vtk"], "um")
        assert np.array_equal(mesh.faces, own.faces)
        assert 0 < np.abs(mesh.vertices - own.vertices).mean() < PIXEL
    said = json.loads((folder / "again" / "summary.json").read_text())
    assert said["surfaces"]["train"]["mean"]["l1"] < 1.05 * said["run"]["train"]["mean"]["l1"]
