"""The command line: its contract on tiny scenes, and what it says and leaves behind when the input is bad."""

from __future__ import annotations

import contextlib
import importlib.metadata
import io
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import h5py
import numpy as np
import pytest

import holosplat.cli.commands as commands
import holosplat.cli.options as cli_options
from holosplat.baselines import HolographicTV
from holosplat.cli import main
from holosplat.fit.loop import FitOptions
from holosplat.fit.objective import Objective
from holosplat.fit.schedule import Schedule
from holosplat.geometry import Grid, Views
from holosplat.io.nxtomo import read_scan, write_scan
from holosplat.io.volumes import read_volume
from holosplat.io.vtk import read_meshes, write_mesh
from holosplat.materials import HAEMOGLOBIN, PLASMA, RED_CELL, Compound
from holosplat.mesh import TriangleMesh
from holosplat.specimens.red_cells import icosphere, random_cells
from holosplat.workflows.evaluate import evaluate, render
from holosplat.workflows.reconstruct import load_reconstruction
from holosplat.workflows.run_folder import RunFolder
from holosplat.workflows.settings import Settings, preset

PIXEL = 3.2e-6
ROWS, COLUMNS = 24, 28
FORMULA = "C2952H4664N812O832S8Fe4"
MATTER = ["--length-unit", "um", "--material", FORMULA, "--density", "1.335"]
BEAM = ["--energy-kev", "20", "--distance", "0.1", "--pixel-size", "3.2e-6", "--detector", "24", "28"]

QUICK = Settings(
    spacing_px=2.0,
    approximate_steps=5,
    volume=HolographicTV(iterations=30, corrections=2, inner=8, refine=1),
    fit=FitOptions(Objective(tv_volume=0.05, overfull=10.0), Schedule(steps=6)),
)
"""Settings for runs whose quality does not matter."""


@dataclass(frozen=True)
class Outcome:
    """What a command gave back."""

    code: int
    out: str
    err: str

    @property
    def said(self) -> str:
        """stderr on one line, without frames."""
        return re.sub(r"[\s│╭╮╰╯─|+-]+", " ", self.err)


def holosplat(*arguments: object) -> Outcome:
    """Run a command within this process, where any exception but a clean exit fails the test."""
    out, err, before = io.StringIO(), io.StringIO(), sys.argv
    sys.argv = ["holosplat", *map(str, arguments)]
    code: object = 0
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            main()
    except SystemExit as end:
        code = end.code or 0
    finally:
        sys.argv = before
    assert isinstance(code, int)
    return Outcome(code, out.getvalue(), err.getvalue())


PROGRAM = [sys.executable, "-c", "from holosplat.cli import main; main()"]


def in_a_shell(*arguments: object, cwd: Path) -> Outcome:
    """Run a command as a process of its own."""
    done = subprocess.run([*PROGRAM, *map(str, arguments)], cwd=cwd, capture_output=True, text=True, timeout=120)
    assert "Traceback" not in done.stderr
    return Outcome(done.returncode, done.stdout, done.stderr)


def worked(outcome: Outcome) -> Outcome:
    assert outcome.code == 0, outcome.err
    assert "holosplat:" not in outcome.err
    return outcome


@dataclass(frozen=True)
class Workshop:
    """Files that several tests read: meshes, their scan and true volume, quick settings, and a run."""

    path: Path
    cells: tuple[Path, ...]
    scan: Path
    truth: Path
    quick: Path
    run: Path


@pytest.fixture(scope="module")
def shop(tmp_path_factory) -> Workshop:
    """Two red cells, eight views of them (the fourth and eighth held out), and a run on these."""
    path = tmp_path_factory.mktemp("shop")
    cells = random_cells(2, (COLUMNS * PIXEL, ROWS * PIXEL, COLUMNS * PIXEL), 1, 12 * PIXEL)
    files = tuple(path / f"{cell.name}.vtk" for cell in cells)
    for cell, file in zip(cells, files):
        write_mesh(file, cell, "um")
    made = Workshop(path, files, path / "scan.nxs", path / "truth.h5", path / "quick.json", path / "run")
    made.quick.write_text(json.dumps(asdict(QUICK)))
    worked(simulate(made, "--views", 8, "--out", made.scan, "--truth", made.truth))
    worked(holosplat("reconstruct", made.scan, "--out", made.run, *known(made), "--seed", 5))
    return made


def simulate(shop: Workshop, *options: object) -> Outcome:
    return holosplat("simulate", *shop.cells, *MATTER, *BEAM, *options)


def known(shop: Workshop) -> list[object]:
    """The material, and the quick settings."""
    return ["--material", "haemoglobin", "--config", shop.quick]


def copied(source: Path, folder: Path, change: Callable[[h5py.File], object]) -> Path:
    """A changed copy of an HDF5 file."""
    target = Path(shutil.copy(source, folder))
    with h5py.File(target, "r+") as file:
        change(file)
    return target


# --- the contract -------------------------------------------------------------------------------------------


def test_the_installed_command_is_main():
    (entry,) = importlib.metadata.entry_points(group="console_scripts", name="holosplat")
    assert entry.load() is main


@pytest.mark.parametrize("command", ["simulate", "reconstruct", "render", "export", "evaluate", "demo"])
def test_every_command_explains_itself(command):
    outcome = worked(holosplat(command, "--help"))
    assert f"holosplat {command}" in outcome.out
    assert "--out" in outcome.out or "--volume" in outcome.out or "--truth" in outcome.out


def test_the_whole_chain_as_processes(shop, tmp_path):
    """simulate, reconstruct with a preset, render, export, evaluate: files in, files out, nothing else."""
    cells = [os.path.relpath(cell, tmp_path) for cell in shop.cells]
    options = [*MATTER, *BEAM, "--views", 8, "--psf-sigma-px", 0.3, "--photons-per-pixel", 20000, "--seed", 3]
    worked(in_a_shell("simulate", *cells, *options, "--out", "scan.nxs", "--truth", "truth.h5", cwd=tmp_path))
    fitted = in_a_shell(
        *["reconstruct", "scan.nxs", "--out", "RUN", "--material", FORMULA, "--density", 1.335],
        *["--preset", "fast", "--seed", 4],
        cwd=tmp_path,
    )
    assert "held-out frames: SSIM" in worked(fitted).out
    assert "report: RUN/report.html" in fitted.err
    worked(in_a_shell("render", "RUN", "--scan", "scan.nxs", "--out", "predicted.nxs", cwd=tmp_path))
    worked(in_a_shell("export", "RUN", "--volume", "volume.h5", cwd=tmp_path))
    scored = in_a_shell("evaluate", "RUN", "--truth", "truth.h5", "--json", cwd=tmp_path)
    scores = json.loads(worked(scored).out)
    assert scores["ssim"] > 0.8
    assert scores["dice"] > 0.9
    worked(holosplat("evaluate", tmp_path / "RUN"))  # it knows its scan from any folder
    found = {path.name for path in tmp_path.iterdir()}
    assert found == {"scan.nxs", "truth.h5", "RUN", "predicted.nxs", "volume.h5"}
    names = {
        "config.json",
        "metrics.csv",
        "checkpoint.pt",
        "gaussians.h5",
        "summary.json",
        "source.json",
        "report.html",
    }
    assert {path.name for path in (tmp_path / "RUN").iterdir()} == names
    assert "</html>" in (tmp_path / "RUN/report.html").read_text()
    config = json.loads((tmp_path / "RUN/config.json").read_text())
    assert config["settings"] == asdict(preset("fast"))
    assert config["seed"] == 4


def test_the_demo_runs_the_chain_and_shows_its_commands(shop, tmp_path, monkeypatch):
    """Here on the two small cells."""
    monkeypatch.setattr(commands, "DETECTOR", (ROWS, COLUMNS))
    monkeypatch.setattr(
        commands, "write_demo_meshes", lambda folder: [Path(shutil.copy(c, folder)) for c in shop.cells]
    )
    monkeypatch.setattr(cli_options, "preset", lambda name: QUICK)
    outcome = worked(holosplat("demo", "--out", tmp_path / "demo"))
    found = {path.name for path in (tmp_path / "demo").iterdir()}
    assert found == {"meshes", "scan.nxs", "truth.h5", "run"}
    assert (tmp_path / "demo/run/report.html").is_file()
    for command in ("simulate", "reconstruct", "evaluate"):
        assert f"$ holosplat {command}" in outcome.err
    assert "volume: Dice" in outcome.out
    again = holosplat("demo", "--out", tmp_path / "demo")
    assert (again.code, "--out" in again.err) == (2, True)


# --- simulate -----------------------------------------------------------------------------------------------


def test_a_simulated_scan_holds_what_was_asked_for(shop):
    scan, exposures = read_scan(shop.scan), read_scan(shop.scan).exposures
    wanted = Views.evenly_spaced(8, (ROWS, COLUMNS), PIXEL)
    np.testing.assert_allclose(scan.views.rotations, wanted.rotations, atol=1e-12)
    assert (scan.views.shape, scan.views.pixel_size) == ((ROWS, COLUMNS), PIXEL)
    assert (set(exposures.energy_kev), set(exposures.distance)) == ({20.0}, {0.1})
    assert scan.is_test.tolist() == [False, False, False, True] * 2
    assert scan.provenance["materials"].startswith("delta 7.4")
    assert scan.frames.std() > 0.03
    truth = read_volume(shop.truth)
    assert truth.grid == Grid.of_views(wanted)
    volume = sum(mesh.volume for mesh in read_meshes(shop.cells, "um"))
    material = HAEMOGLOBIN.delta_beta(20)
    assert truth.delta.sum() * PIXEL**3 == pytest.approx(material.delta * volume, rel=0.01, abs=0)
    assert truth.beta.sum() * PIXEL**3 == pytest.approx(material.beta * volume, rel=0.01, abs=0)


def test_angles_may_be_listed_and_negative(shop, tmp_path):
    out = tmp_path / "scan.nxs"
    worked(simulate(shop, "--angles-deg", -30, "0", "45.5", "-1e1", "--out", out, "--test-every", 0))
    wanted = Views.from_angles([-30, 0, 45.5, -10], (ROWS, COLUMNS), PIXEL)
    np.testing.assert_allclose(read_scan(out).views.rotations, wanted.rotations, atol=1e-12)
    assert not read_scan(out).is_test.any()


def test_poses_may_be_matrices(shop, tmp_path):
    matrices = Views.from_angles([10, 80], (1, 1), 1.0).rotations
    np.save(tmp_path / "poses.npy", matrices)
    worked(simulate(shop, "--rotations", tmp_path / "poses.npy", "--out", tmp_path / "scan.nxs"))
    np.testing.assert_allclose(read_scan(tmp_path / "scan.nxs").views.rotations, matrices, atol=1e-12)


def test_photon_noise_follows_its_seed(shop, tmp_path):
    frames = []
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        options = ["--views", 2, "--photons-per-pixel", 1000, "--seed", seed, "--out", tmp_path / f"{name}.nxs"]
        worked(simulate(shop, *options))
        frames.append(read_scan(tmp_path / f"{name}.nxs").frames)
    clean = read_scan(shop.scan).frames[0]
    np.testing.assert_array_equal(frames[0], frames[1])
    assert not np.array_equal(frames[0], frames[2])
    assert (frames[0][0] - clean).std() == pytest.approx(1000**-0.5, rel=0.15)


def test_a_medium_is_subtracted_and_a_table_fills_each_mesh(shop, tmp_path):
    """Cells in plasma: Δβ < 0. A table of materials by file name overrides the one material."""
    options = ["--views", 1, "--test-every", 0, "--out", tmp_path / "scan.nxs", "--truth", tmp_path / "truth.h5"]
    worked(holosplat("simulate", *shop.cells, *BEAM, "--material", "red cell", "--medium", "plasma", *options))
    truth = read_volume(tmp_path / "truth.h5")
    contrast = RED_CELL.delta_beta(20).against(PLASMA.delta_beta(20))
    assert truth.delta.max() == pytest.approx(contrast.delta, rel=1e-3, abs=0)
    assert truth.beta.min() == pytest.approx(contrast.beta, rel=1e-3, abs=0)
    table = tmp_path / "materials.json"
    table.write_text(json.dumps({"*01.vtk": {"formula": "SiO2", "density": 2.2}}))
    worked(holosplat("simulate", *shop.cells, *MATTER, *BEAM, "--materials", table, *options))
    truth = read_volume(tmp_path / "truth.h5").delta
    for matter in (HAEMOGLOBIN, Compound("SiO2", 2.2)):
        near = np.abs(truth / matter.delta_beta(20).delta - 1) < 1e-3
        assert near.sum() > 20


@pytest.fixture(scope="module")
def ball(tmp_path_factory) -> Path:
    """A ball of 15 µm radius about (-30, 12, 7.5) µm."""
    vertices, faces = icosphere(3)
    path = tmp_path_factory.mktemp("ball") / "ball.vtk"
    write_mesh(path, TriangleMesh(1e-6 * (15 * vertices + np.array([-30, 12, 7.5])), faces), "um")
    return path


@pytest.mark.parametrize(
    ("origin", "centre"),
    [
        (["--origin", "-30", "12", "7.5"], (0, 0, 0)),
        (["--origin", "-3.9e1", "16.5", "1.5"], (9, -4.5, 6)),
        ([], (0, 0, 0)),
    ],
)
def test_the_origin_is_the_point_on_the_axis_in_the_files_coordinates(ball, tmp_path, origin, centre):
    """In the true volume, and in the frames: at 0° x runs along columns and y along rows, at 90° z along columns."""
    options = ["--angles-deg", 0, 90, "--test-every", 0, "--out", tmp_path / "s.nxs", "--truth", tmp_path / "t.h5"]
    outcome = worked(holosplat("simulate", ball, *MATTER, *BEAM, *options, *origin))
    assert "warning" not in outcome.err
    truth = read_volume(tmp_path / "t.h5")
    z, y, x = np.meshgrid(*truth.grid.axes()[::-1], indexing="ij")
    found = [1e6 * float((axis * truth.delta).sum() / truth.delta.sum()) for axis in (x, y, z)]
    np.testing.assert_allclose(found, centre, atol=0.1)
    frames = np.abs(read_scan(tmp_path / "s.nxs").frames.astype(float) - 1)
    rows = (np.arange(ROWS) + 0.5 - ROWS / 2)[:, None] * 1e6 * PIXEL
    columns = (np.arange(COLUMNS) + 0.5 - COLUMNS / 2) * 1e6 * PIXEL
    for frame, column in zip(frames, (centre[0], centre[2])):
        assert (frame * rows).sum() / frame.sum() == pytest.approx(centre[1], abs=0.6)
        assert (frame * columns).sum() / frame.sum() == pytest.approx(column, abs=0.6)


def test_a_scene_beyond_the_detector_is_simulated_with_a_warning_that_says_by_how_much(ball, tmp_path):
    """The ball reaches 15 µm up and down; 8 rows show 12.8 µm: 2.2 µm are missing, 0.69 pixels."""
    beam = [*BEAM[:-2], "8", "28"]
    options = ["--views", 2, "--out", tmp_path / "scan.nxs"]
    outcome = worked(holosplat("simulate", ball, *MATTER, *beam, *options))
    assert re.search(
        r"warning: .* 2\.\d+ µm \(0\.6\d* pixels\) beyond the detector .*--detector.*--origin", outcome.err
    )
    assert read_scan(tmp_path / "scan.nxs").views.shape == (8, 28)


# --- reconstruct, render, export, evaluate ------------------------------------------------------------------


def test_a_run_knows_its_material_seed_and_settings(shop):
    config = json.loads((shop.run / "config.json").read_text())
    material = HAEMOGLOBIN.delta_beta(20)
    assert config["prior"] == {"kind": "known", "delta": material.delta, "beta": material.beta, "ratio": 0.0}
    assert config["seed"] == 5
    assert config["settings"] == asdict(QUICK)


@pytest.mark.parametrize(("options", "kind"), [([], "free"), (["--delta-beta", "2800"], "ratio")])
def test_less_may_be_known_of_the_matter(shop, tmp_path, options, kind):
    out = tmp_path / "run"
    outcome = worked(holosplat("reconstruct", shop.scan, "--out", out, "--config", shop.quick, *options))
    assert json.loads((out / "config.json").read_text())["prior"]["kind"] == kind
    assert re.search(r"material: δ \d\.\d+e-07, δ/β \d+", outcome.out)


def test_a_medium_belongs_to_the_material(shop, tmp_path):
    out = tmp_path / "run"
    matter = ["--material", "red cell", "--medium", "plasma"]
    worked(holosplat("reconstruct", shop.scan, "--out", out, "--config", shop.quick, *matter))
    contrast = RED_CELL.delta_beta(20).against(PLASMA.delta_beta(20))
    prior = json.loads((out / "config.json").read_text())["prior"]
    assert (prior["delta"], prior["beta"]) == pytest.approx(contrast, rel=1e-9, abs=0)


@pytest.mark.parametrize(("split", "chosen"), [("test", [3, 7]), ("train", [0, 1, 2, 4, 5, 6]), ("all", range(8))])
def test_rendered_frames_are_in_the_scans_order_and_layout(shop, tmp_path, split, chosen):
    out = tmp_path / "predicted.nxs"
    options = [] if split == "test" else ["--split", split]
    worked(holosplat("render", shop.run, "--scan", shop.scan, "--out", out, *options))
    measured, predicted = read_scan(shop.scan)[list(chosen)], read_scan(out)
    np.testing.assert_array_equal(predicted.views.rotations, measured.views.rotations)
    np.testing.assert_array_equal(predicted.is_test, measured.is_test)
    np.testing.assert_array_equal(predicted.exposures.distance, measured.exposures.distance)
    assert set(predicted.exposures.energy_kev) == set(measured.exposures.energy_kev)
    wanted = render(load_reconstruction(RunFolder(shop.run)), measured.exposures)
    np.testing.assert_allclose(predicted.frames, wanted, rtol=0, atol=1e-6)
    errors = [[np.abs(p - m).mean() for m in measured.frames] for p in predicted.frames]
    assert np.argmin(errors, axis=1).tolist() == list(range(len(chosen)))


def test_an_exported_volume_is_the_fields_or_as_asked(shop, tmp_path):
    cloud, out = load_reconstruction(RunFolder(shop.run)).cloud, tmp_path / "volume.h5"
    for options, grid in (
        ([], Grid.centred((COLUMNS, ROWS, COLUMNS), PIXEL)),
        (["--shape", 10, 12, 14, "--voxel-size", 5e-6], Grid.centred((10, 12, 14), 5e-6)),
        (["--shape", 10, 12, 14], Grid.centred((10, 12, 14), PIXEL)),
    ):
        worked(holosplat("export", shop.run, "--volume", out, *options))
        volume = read_volume(out)
        assert volume.grid.shape == grid.shape
        np.testing.assert_allclose(volume.grid.voxel_size, grid.voxel_size)
        np.testing.assert_allclose(volume.grid.origin, grid.origin, rtol=1e-12)
        np.testing.assert_array_equal(volume.delta, cloud.voxelise(grid).delta)
        np.testing.assert_array_equal(volume.beta, cloud.voxelise(grid).beta)


def test_scores_are_those_of_the_python_api(shop):
    result, scan = load_reconstruction(RunFolder(shop.run)), read_scan(shop.scan)
    wanted = evaluate(result, scan, read_volume(shop.truth))
    report = shop.run / "report.html"
    report.unlink()
    outcome = worked(holosplat("evaluate", shop.run, "--truth", shop.truth, "--json"))
    assert json.loads(outcome.out) == json.loads(json.dumps(wanted.as_dict()))
    assert report.is_file()
    table = worked(holosplat("evaluate", shop.run, "--scan", shop.scan, "--truth", shop.truth))
    assert table.out.splitlines() == wanted.lines()


def test_another_scan_is_scored_but_does_not_enter_the_report(shop, tmp_path):
    """Its held-out frames may be some that were fitted: a line says so."""
    scan = read_scan(shop.scan)
    write_scan(tmp_path / "other.nxs", replace(scan, is_test=~scan.is_test))
    before = (shop.run / "report.html").read_bytes()
    outcome = worked(holosplat("evaluate", shop.run, "--scan", tmp_path / "other.nxs", "--truth", shop.truth))
    assert "held-out frames: SSIM" in outcome.out
    assert "not the scan" in outcome.err
    assert (shop.run / "report.html").read_bytes() == before


def test_a_run_finds_its_scan_or_asks_for_it(shop, tmp_path):
    """From any folder; and where the scan was moved away, it can be named."""
    scan, run = Path(shutil.copy(shop.scan, tmp_path)), tmp_path / "run"
    shutil.copytree(shop.run, run)
    (run / "source.json").write_text(json.dumps({"scan": str(scan)}))
    worked(holosplat("evaluate", run))
    scan.rename(tmp_path / "moved.nxs")
    refused(holosplat("evaluate", run), "scan.nxs", "--scan")
    worked(holosplat("evaluate", run, "--scan", tmp_path / "moved.nxs"))
    (run / "source.json").unlink()  # as in runs made from Python
    refused(holosplat("evaluate", run), str(run), "--scan")


def test_ctrl_c_leaves_a_usable_run_that_goes_on(shop, tmp_path):
    """Exit code 130, a result and its report; --resume ends the fit."""
    long = replace(QUICK, fit=replace(QUICK.fit, schedule=Schedule(steps=1000)))
    (tmp_path / "long.json").write_text(json.dumps(asdict(long)))
    arguments = ["reconstruct", shop.scan, "--out", "run", "--material", "haemoglobin", "--config", "long.json"]
    log = tmp_path / "stderr"
    with log.open("w") as stderr:
        process = subprocess.Popen(
            [*PROGRAM, *map(str, arguments)], cwd=tmp_path, stdout=subprocess.PIPE, stderr=stderr, text=True
        )
        deadline = time.monotonic() + 60
        while "steps/s" not in log.read_text() and time.monotonic() < deadline:
            time.sleep(0.05)
        process.send_signal(signal.SIGINT)
        out, _ = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "Traceback" not in log.read_text()
    assert "--resume" in log.read_text()
    assert "held-out frames" in out
    summary = json.loads((tmp_path / "run/summary.json").read_text())
    assert (summary["finished"], 0 < summary["steps"] < 1000) == (False, True)
    assert (tmp_path / "run/report.html").is_file()
    worked(holosplat("evaluate", tmp_path / "run"))
    other = holosplat("reconstruct", shop.scan, "--out", tmp_path / "run", *known(shop), "--resume")
    refused(other, "--resume", "settings")
    before = json.loads((tmp_path / "run/summary.json").read_text())["steps"]
    with contextlib.chdir(tmp_path):
        outcome = worked(holosplat(*arguments, "--resume"))
    assert before == summary["steps"]
    assert "phase retrieval" not in outcome.err
    assert json.loads((tmp_path / "run/summary.json").read_text())["finished"] is True


def test_ctrl_c_during_the_start_leaves_nothing(shop, tmp_path, monkeypatch):
    def pressed(*arguments: object, **options: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(commands, "fit", pressed)
    outcome = holosplat("reconstruct", shop.scan, "--out", tmp_path / "run", *known(shop))
    assert outcome.code == 130
    assert outcome.err.strip().splitlines()[-1] == "holosplat: interrupted"
    assert list(tmp_path.iterdir()) == []


# --- bad input ----------------------------------------------------------------------------------------------


def refused(outcome: Outcome, *words: str) -> None:
    """Exit code 2 and one clear sentence (or two) on stderr, holding `words`."""
    assert outcome.code == 2, outcome
    assert "Traceback" not in outcome.err
    lines = [line for line in outcome.err.splitlines() if line.startswith("holosplat: ")]
    assert len(lines) == 1, outcome.err
    assert outcome.err.rstrip().endswith(lines[0])
    assert lines[0].endswith((".", "?"))
    assert "np." not in lines[0]
    for word in words:
        assert word in lines[0], f"{word!r} not in {lines[0]!r}"


def everything_in(folder: Path) -> set[str]:
    """All that is in a folder, hidden files too, with sizes and times."""
    return {f"{path} {path.stat().st_size} {path.stat().st_mtime_ns}" for path in folder.rglob("*")}


DETECTOR = "entry/instrument/detector"


def put(name: str, value: object, units: str | None = None) -> Callable[[h5py.File], None]:
    """A change that replaces a dataset, keeping its unit unless another one is given."""

    def change(file: h5py.File) -> None:
        before = file[name].attrs.get("units")
        del file[name]
        file[name] = value
        if units or before:
            file[name].attrs["units"] = units or before

    return change


def drop(name: str) -> Callable[[h5py.File], None]:
    return lambda file: file.__delitem__(name)


def five_angles(file: h5py.File) -> None:
    for name in ("entry/sample/view_rotation", "entry/sample/rotation_angle", "entry/data/rotation_angle"):
        del file[name]
    file["entry/sample/rotation_angle"] = np.arange(5.0)
    file["entry/sample/rotation_angle"].attrs["units"] = "deg"


def huge_pixels(file: h5py.File) -> None:
    for axis in "xy":
        put(f"{DETECTOR}/{axis}_pixel_size", 3.2)(file)


def one_nan(file: h5py.File) -> None:
    file[f"{DETECTOR}/data"][2, 3, 4] = np.nan


def truncated(file: Path, folder: Path) -> Path:
    """The first half of a file."""
    target = folder / file.name
    target.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    return target


BAD_SCANS: dict[str, tuple[Callable[[h5py.File], object], list[str]]] = {
    "missing energy": (
        lambda f: f.__delitem__("entry/instrument/beam/incident_energy"),
        ["incident_energy", "missing"],
    ),
    "negative energy": (put("entry/instrument/beam/incident_energy", -20.0), ["incident_energy", "positive", "-20"]),
    "energy in eV": (put("entry/instrument/beam/incident_energy", 2e4), ["incident_energy", "20000", "unit"]),
    "wrong number of angles": (five_angles, ["rotation_angle", "8", "5"]),
    "unknown unit": (put(f"{DETECTOR}/distance", 0.1, "furlong"), ["detector/distance", "furlong", "mm"]),
    "negative distance": (put(f"{DETECTOR}/distance", -0.1), ["detector/distance", "positive", "-0.1"]),
    "NaN images": (one_nan, ["detector/data", "finite", "1 of 5376"]),
    "no training frame": (put("entry/split", np.ones(8, int)), ["training frame", "/entry/split"]),
    "a pixel of 3.2 m": (huge_pixels, ["pixel_size", "3.2", "unit"]),
    "no images": (drop(f"{DETECTOR}/data"), ["detector/data", "missing"]),
    "nothing to see": (put(f"{DETECTOR}/data", np.ones((8, 24, 28))), ["no matter"]),
}


@pytest.mark.parametrize("fault", BAD_SCANS)
def test_bad_scans_are_refused_and_leave_no_run(shop, tmp_path, fault):
    change, words = BAD_SCANS[fault]
    scan = copied(shop.scan, tmp_path, change)
    before = everything_in(tmp_path)
    refused(holosplat("reconstruct", scan, "--out", tmp_path / "run", *known(shop)), *words)
    assert everything_in(tmp_path) == before


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("missing.nxs", None, ["missing.nxs", "no such file"]),
        ("empty.nxs", b"", ["empty.nxs", "HDF5"]),
        ("text.nxs", b"hello", ["text.nxs", "HDF5"]),
        ("scan.nxs", "half", ["scan.nxs", "truncated"]),
        (".", None, ["folder"]),
    ],
)
def test_files_that_are_no_scans_are_refused(shop, tmp_path, name, content, words):
    if content == "half":
        truncated(shop.scan, tmp_path)
    elif content is not None:
        (tmp_path / name).write_bytes(content)
    before = everything_in(tmp_path)
    for command in (
        ["reconstruct", tmp_path / name, "--out", tmp_path / "new", *known(shop)],
        ["render", shop.run, "--scan", tmp_path / name, "--out", tmp_path / "new.nxs"],
        ["evaluate", shop.run, "--scan", tmp_path / name],
    ):
        refused(holosplat(*command), *words)
        assert everything_in(tmp_path) == before


def test_bad_input_in_a_shell_gives_one_line_and_no_traceback(shop, tmp_path):
    """As people meet it: the process ends with 2 and stderr is that line alone."""
    truncated(shop.scan, tmp_path)
    for arguments, word in (
        (["reconstruct", "scan.nxs", "--out", "run"], "truncated"),
        (["evaluate", "nowhere"], "nowhere"),
        (["simulate", shop.cells[0], *MATTER, *BEAM, "--views", 0, "--out", "o.nxs"], "views"),
    ):
        outcome = in_a_shell(*arguments, cwd=tmp_path)
        refused(outcome, word)
        assert len(outcome.err.strip().splitlines()) == 1
        assert outcome.out == ""
    assert [path.name for path in tmp_path.iterdir()] == ["scan.nxs"]


BAD_REQUESTS: dict[str, tuple[list[str], list[str]]] = {
    "unknown preset": (["--material", "haemoglobin", "--preset", "quick"], ["preset", "default", "fast", "quick"]),
    "bad formula": (["--material", "H2Q", "--density", "1"], ["material", "H2Q"]),
    "formula without density": (["--material", "H2O"], ["H2O", "density"]),
    "negative density": (["--material", "H2O", "--density", "-1"], ["density", "positive", "-1"]),
    "density in kg/m3": (["--material", "H2O", "--density", "1000"], ["density", "g/cm³", "1000"]),
    "density alone": (["--density", "1"], ["--density", "--material"]),
    "material and ratio": (["--material", "haemoglobin", "--delta-beta", "2800"], ["--material", "--delta-beta"]),
    "ratio and density": (["--delta-beta", "2800", "--density", "1"], ["--density", "--delta-beta"]),
    "ratio and medium": (["--delta-beta", "2800", "--medium", "water"], ["--medium", "--delta-beta"]),
    "ratio of zero": (["--delta-beta", "0"], ["delta", "beta", "0"]),
    "lighter than its medium": (["--material", "water", "--medium", "haemoglobin"], ["δ", "medium"]),
    "missing config": (["--config", "none.json"], ["none.json"]),
    "config and preset": (["--config", "quick.json", "--preset", "fast"], ["--config", "--preset"]),
}


@pytest.mark.parametrize("fault", BAD_REQUESTS)
def test_bad_requests_are_refused_and_leave_no_run(shop, tmp_path, fault):
    options, words = BAD_REQUESTS[fault]
    with contextlib.chdir(shop.path):
        refused(holosplat("reconstruct", shop.scan, "--out", tmp_path / "run", *options), *words)
    assert list(tmp_path.iterdir()) == []


def test_outputs_that_cannot_be_are_refused_before_any_work(shop, tmp_path):
    """A taken folder, a file, and a folder in none; nothing changes, and nothing was computed."""
    (tmp_path / "file").write_text("mine")
    before = everything_in(tmp_path), everything_in(shop.run)
    for out, words in (
        (shop.run, ["--out", "new or empty", "--resume"]),
        (tmp_path / "file", ["--out", "file"]),
        (tmp_path / "none/run", ["--out", "existing folder"]),
    ):
        outcome = holosplat("reconstruct", shop.scan, "--out", out, *known(shop))
        refused(outcome, *words)
        assert "phase retrieval" not in outcome.err
    for out in (tmp_path / "none/scan.nxs", tmp_path):
        outcome = simulate(shop, "--views", 2, "--out", out)
        refused(outcome, str(out), "folder")
        assert "simulating" not in outcome.err
    refused(holosplat("render", shop.run, "--scan", shop.scan, "--out", tmp_path / "none/p.nxs"), "existing folder")
    refused(holosplat("export", shop.run, "--volume", tmp_path / "none/v.h5"), "existing folder")
    assert (everything_in(tmp_path), everything_in(shop.run)) == before


def test_a_truth_that_cannot_be_written_is_refused_before_the_scan_is_made(shop, tmp_path):
    outcome = simulate(shop, "--views", 2, "--out", tmp_path / "scan.nxs", "--truth", tmp_path / "none/truth.h5")
    refused(outcome, "truth.h5", "existing folder")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--preset", "fast", "--material", "haemoglobin", "--seed", "5"], ["--resume", "settings"]),
        (["--material", "haemoglobin", "--config", "quick.json", "--seed", "6"], ["--resume", "seed"]),
        (["--material", "water", "--config", "quick.json", "--seed", "5"], ["--resume", "material"]),
    ],
)
def test_resuming_with_other_options_is_refused(shop, options, words):
    before = everything_in(shop.run)
    with contextlib.chdir(shop.path):
        refused(holosplat("reconstruct", shop.scan, "--out", shop.run, "--resume", *options), *words)
    assert everything_in(shop.run) == before


def test_resuming_with_another_scan_is_refused(shop, tmp_path):
    scan = read_scan(shop.scan)
    write_scan(tmp_path / "other.nxs", replace(scan, frames=scan.frames + np.float32(0.01)))
    before = everything_in(shop.run)
    outcome = holosplat("reconstruct", tmp_path / "other.nxs", "--out", shop.run, "--resume", *known(shop), "--seed", 5)
    refused(outcome, "--resume", "scan ")
    assert everything_in(shop.run) == before


def test_resuming_what_is_no_run_does_not_advise_to_resume(shop, tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    outcome = holosplat("reconstruct", shop.scan, "--out", tmp_path, "--resume", *known(shop))
    refused(outcome, str(tmp_path))
    assert "add --resume" not in outcome.err
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]


def altered(*pairs: str, drop: str = "") -> list[str]:
    """`simulate`'s options with some replaced, and perhaps one left out."""
    usual = {
        "--length-unit": "um",
        "--material": "haemoglobin",
        "--energy-kev": "20",
        "--distance": "0.1",
        "--pixel-size": "3.2e-6",
        "--detector": "24 28",
        "--views": "2",
    }
    usual |= dict(zip(pairs[::2], pairs[1::2]))
    usual.pop(drop, None)
    return [word for flag, values in usual.items() for word in (flag, *values.split())]


BAD_SCENES: dict[str, tuple[list[str], list[str]]] = {
    "unknown length unit": (altered("--length-unit", "furlong"), ["furlong", "um"]),
    "bad formula": (altered("--material", "Xx2"), ["material", "Xx2"]),
    "formula without density": (altered("--material", "H2O"), ["H2O", "density"]),
    "negative density": (altered("--material", "H2O", "--density", "-1"), ["density", "positive"]),
    "medium's density alone": (altered("--medium-density", "1"), ["--medium-density", "--medium"]),
    "no energy": (altered("--energy-kev", "0"), ["energy", "positive", "keV"]),
    "negative energy": (altered("--energy-kev", "-20"), ["energy", "positive", "-20"]),
    "energy in eV": (altered("--energy-kev", "20000"), ["energy", "20000", "unit"]),
    "no distance": (altered("--distance", "0"), ["distance", "positive"]),
    "negative distance": (altered("--distance", "-0.1"), ["distance", "positive", "-0.1"]),
    "infinite distance": (altered("--distance", "inf"), ["distance", "positive", "inf"]),
    "pixel of no size": (altered("--pixel-size", "0"), ["pixel size", "positive"]),
    "negative pixel": (altered("--pixel-size", "-3.2e-6"), ["pixel size", "positive", "-3.2e-06"]),
    "pixel of metres": (altered("--pixel-size", "3.2"), ["pixel size", "3.2", "unit"]),
    "no rows": (altered("--detector", "0 28"), ["detector", "positive", "(0, 28)"]),
    "negative rows": (altered("--detector", "-24 28"), ["detector", "positive", "(-24, 28)"]),
    "no views": (altered("--views", "0"), ["views", "at least 1", "0"]),
    "views and angles": (altered("--angles-deg", "0 10"), ["--views", "--angles-deg"]),
    "neither views nor angles": (altered(drop="--views"), ["--views", "--angles-deg"]),
    "an angle that is none": (altered("--angles-deg", "0 nan", drop="--views"), ["angle", "nan"]),
    "an origin that is none": (altered("--origin", "nan 0 0"), ["origin", "nan"]),
    "negative blur": (altered("--psf-sigma-px", "-1"), ["psf", "negative"]),
    "no photons": (altered("--photons-per-pixel", "0"), ["photons", "positive"]),
    "too many photons": (altered("--photons-per-pixel", "1e30"), ["photons", "1e+30"]),
    "negative seed": (altered("--photons-per-pixel", "100", "--seed", "-1"), ["seed", "-1"]),
    "all frames held out": (altered("--test-every", "1"), ["test", "every"]),
}


@pytest.mark.parametrize("fault", BAD_SCENES)
def test_bad_scenes_are_refused_before_any_work_and_leave_nothing(shop, tmp_path, fault):
    options, words = BAD_SCENES[fault]
    outcome = holosplat("simulate", shop.cells[0], *options, "--out", tmp_path / "scan.nxs")
    refused(outcome, *words)
    assert "simulating" not in outcome.err
    assert list(tmp_path.iterdir()) == []


def test_bad_meshes_are_refused(shop, tmp_path):
    whole = read_meshes(shop.cells[0], "um")[0]
    write_mesh(tmp_path / "open.vtk", TriangleMesh(whole.vertices, whole.faces[:-1]), "um")
    (tmp_path / "text.vtk").write_text("hello")
    (tmp_path / "cut.vtk").write_bytes(shop.cells[0].read_bytes()[:3000])
    before = everything_in(tmp_path)
    for name, words in (
        ("open.vtk", ["open.vtk", "closed", "3 open edges"]),
        ("text.vtk", ["text.vtk", "VTK"]),
        ("cut.vtk", ["cut.vtk", "truncated"]),
        ("none.vtk", ["none.vtk", "no such file"]),
    ):
        out = ["--out", tmp_path / "scan.nxs", "--truth", tmp_path / "truth.h5"]
        refused(holosplat("simulate", shop.cells[0], tmp_path / name, *altered(), *out), *words)
        assert everything_in(tmp_path) == before
    refused(holosplat("simulate", *altered(), "--out", tmp_path / "scan.nxs"), "mesh")


def test_folders_that_are_no_runs_are_refused(shop, tmp_path):
    """Missing, empty, and without a result."""
    (tmp_path / "empty").mkdir()
    shutil.copytree(shop.run, tmp_path / "half")
    (tmp_path / "half/gaussians.h5").unlink()
    before = everything_in(tmp_path)
    for name in ("none", "empty", "half"):
        run = tmp_path / name
        for command in (
            ["render", run, "--scan", shop.scan, "--out", tmp_path / "new.nxs"],
            ["export", run, "--volume", tmp_path / "new.h5"],
            ["evaluate", run, "--scan", shop.scan],
        ):
            refused(holosplat(*command), str(run))
    assert everything_in(tmp_path) == before


@pytest.mark.parametrize(
    ("file", "change", "words"),
    [
        ("gaussians.h5", lambda path: truncated(path, path.parent), ["gaussians.h5", "truncated"]),
        ("summary.json", lambda path: path.write_text("{"), ["summary.json", "JSON"]),
        ("summary.json", lambda path: path.unlink(), ["summary.json"]),
        ("summary.json", lambda path: path.write_text("{}"), ["summary.json"]),
    ],
)
def test_damaged_runs_are_refused(shop, tmp_path, file, change, words):
    run = tmp_path / "run"
    shutil.copytree(shop.run, run)
    change(run / file)
    refused(holosplat("export", run, "--volume", tmp_path / "v.h5"), *words)
    assert not (tmp_path / "v.h5").exists()


def test_bad_truths_are_refused(shop, tmp_path):
    half = truncated(shop.truth, tmp_path)
    refused(holosplat("evaluate", shop.run, "--truth", half), "truth.h5", "truncated")
    refused(holosplat("evaluate", shop.run, "--truth", tmp_path / "none.h5"), "none.h5", "no such file")
    refused(holosplat("evaluate", shop.run, "--truth", shop.scan), "/delta", "missing")


def drop_voxel_size(file: h5py.File) -> None:
    for place in (file, file["delta"], file["beta"]):
        del place.attrs["voxel_size"]


def test_a_truth_without_its_voxel_size_is_refused(shop, tmp_path):
    truth = copied(shop.truth, tmp_path, drop_voxel_size)
    refused(holosplat("evaluate", shop.run, "--truth", truth), "truth.h5", "voxel_size", "missing")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--shape", "0", "4", "4"], ["shape", "positive", "(0, 4, 4)"]),
        (["--shape", "100000", "100000", "100000"], ["shape", "voxels"]),
        (["--voxel-size", "0"], ["voxel", "positive"]),
        (["--voxel-size", "-1e-6"], ["voxel", "positive", "-1e-06"]),
        (["--voxel-size", "3.2"], ["voxel", "3.2", "unit"]),
    ],
)
def test_volumes_that_cannot_be_are_refused(shop, tmp_path, options, words):
    refused(holosplat("export", shop.run, "--volume", tmp_path / "volume.h5", *options), *words)
    assert list(tmp_path.iterdir()) == []


def test_a_split_without_frames_is_refused(shop, tmp_path):
    all_train = copied(shop.scan, tmp_path, put("entry/split", np.zeros(8, int)))
    refused(holosplat("render", shop.run, "--scan", all_train, "--out", tmp_path / "p.nxs"), "test", "--split")
    assert not (tmp_path / "p.nxs").exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["reconstruct", "scan.nxs"], ["--out"]),
        (["reconstruct", "scan.nxs", "--out", "o", "--sead", "1"], ["--sead", "--seed"]),
        (["reconstruct", "scan.nxs", "--out", "o", "--seed", "one"], ["--seed", "one"]),
        (["simulate", "a.vtk", *altered("--detector", "24"), "--out", "o"], ["--detector"]),
        (["simulate", "a.vtk", *altered("--origin", "1 2"), "--out", "o"], ["--origin"]),
        (["render", "run", "--scan", "scan.nxs", "--out", "o", "--split", "some"], ["--split", "some", "train"]),
        (["reconstrukt"], ["reconstrukt", "reconstruct"]),
        ([], ["simulate", "reconstruct"]),
    ],
)
def test_a_wrong_command_line_is_explained(arguments, words):
    outcome = holosplat(*arguments)
    assert outcome.code == 2
    assert "Traceback" not in outcome.err
    for word in words:
        assert word.replace("-", " ").strip() in outcome.said, (word, outcome.err)


def test_a_reader_that_leaves_early_sees_no_traceback():
    """`holosplat backends | head -1`, with a reader that closes at once."""
    command = [sys.executable, "-c", "from holosplat.cli import main; main()", "backends"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout
        assert process.stderr
        process.stdout.close()
        assert "Traceback" not in process.stderr.read()
