"""`holosplat surface`: a run in, VTK files and scores out, and what it says when the input is bad."""

from __future__ import annotations

import json
import shutil
import signal
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from helpers.cli import Outcome, holosplat, worked
from holosplat.baselines import HolographicTV
from holosplat.beamline.simulate import simulate
from holosplat.checks import InputError
from holosplat.fit.problem import Schedule
from holosplat.fit.terms import Objective
from holosplat.geometry import Grid, Views
from holosplat.io.atomic import read_json, write_json
from holosplat.io.nxtomo import read_scan, write_scan
from holosplat.io.objects import write_object
from holosplat.io.volumes import write_volume
from holosplat.io.vtk import read_meshes
from holosplat.materials import HAEMOGLOBIN
from holosplat.matter import MaterialPrior
from holosplat.methods import FitOptions, Gaussians
from holosplat.methods.surface_fit import extract_surfaces
from holosplat.representations import freed
from holosplat.scan import Exposures, interleaved_split
from holosplat.specimens.red_cells import random_cells
from holosplat.specimens.repair import closed
from holosplat.specimens.scene import MeshScene
from holosplat.workflows.reconstruct import load_reconstruction, reconstruct
from holosplat.workflows.run_folder import RunFolder

PIXEL = 1e-6
ROWS, COLUMNS = 25, 29
MATTER = HAEMOGLOBIN.delta_beta(20.0)
QUICK = Gaussians(
    spacing_px=2.0,
    approximate_steps=10,
    volume=HolographicTV(iterations=40, corrections=2, inner=8, refine=1),
    fit=FitOptions(Objective(tv_volume=0.05, overfull=10.0), Schedule(steps=20)),
)
"""Options for runs whose quality does not matter."""


@pytest.fixture(scope="module")
def shop(tmp_path_factory) -> Path:
    """A folder with the scan and the true volume of two cells, and a run."""
    path = tmp_path_factory.mktemp("shop")
    cells = random_cells(2, (COLUMNS * PIXEL, ROWS * PIXEL, COLUMNS * PIXEL), 1, 13 * PIXEL)
    scene = MeshScene.of_one_material(cells, MATTER)
    exposures = Exposures.of(Views.evenly_spaced(8, (ROWS, COLUMNS), PIXEL), 20.0, 0.05)
    scan = simulate(scene, exposures, is_test=interleaved_split(8))
    write_scan(path / "scan.nxs", scan)
    write_volume(path / "truth.h5", scene.voxelise(Grid.of_views(exposures.views)))
    folder = RunFolder(path / "run")
    reconstruct(scan, MaterialPrior.known(MATTER), QUICK, folder=folder)
    write_json(folder.source, {"scan": str(path / "scan.nxs")})
    return path


def refused(outcome: Outcome, *words: str) -> None:
    """Exit code 2, one sentence, no traceback."""
    assert outcome.code == 2, outcome.err
    for word in words:
        assert word in outcome.err or word in outcome.said
    assert "Traceback" not in outcome.err


def test_a_run_becomes_bodies_that_explain_the_frames_better(shop, tmp_path):
    out = tmp_path / "bodies"
    done = worked(holosplat("surface", shop / "run", "--out", out, "--truth", shop / "truth.h5", "--steps", 20))
    assert done.out.index("Gaussians:") < done.out.index("surfaces:")
    assert done.out.count("held-out frames: SSIM") == 2
    assert done.out.count("volume: Dice") == 2
    assert "2 bodies of" in done.err
    assert {path.name for path in out.iterdir()} == {"body000.vtk", "body001.vtk", "summary.json", "provenance.json"}
    summary = read_json(out / "summary.json")
    assert summary["surfaces"]["ssim"] > summary["gaussians"]["ssim"]
    assert summary["surfaces"]["relative_error_delta"] < summary["gaussians"]["relative_error_delta"]
    assert summary["settings"]["fit"]["schedule"]["steps"] == 20
    assert summary["material"]["delta"] == MATTER.delta
    for mesh in read_meshes(out, summary["length_unit"]):
        volume = summary["bodies"][mesh.name.removesuffix(".vtk")]["volume_m3"]
        assert np.isclose(closed(mesh).volume, volume, rtol=1e-3)
    worked(
        holosplat(
            "simulate",
            out,
            "--detector",
            ROWS,
            COLUMNS,
            "--pixel-size",
            PIXEL,
            "--views",
            2,
            "--out",
            tmp_path / "again.nxs",
        )
    )


def test_without_a_truth_there_are_frames_alone(shop, tmp_path):
    done = worked(
        holosplat("surface", shop / "run", "--out", tmp_path / "b", "--scan", shop / "scan.nxs", "--steps", 1)
    )
    assert "volume" not in done.out
    assert "not the scan" not in done.err


def test_another_scan_is_remarked_upon(shop, tmp_path):
    scan = read_scan(shop / "scan.nxs")
    write_scan(tmp_path / "other.nxs", replace(scan, frames=scan.frames[::-1].copy()))
    options = ["--scan", tmp_path / "other.nxs", "--steps", 0]
    done = worked(holosplat("surface", shop / "run", "--out", tmp_path / "b", *options))
    assert "not the scan that was reconstructed" in done.err


def test_a_run_of_an_estimated_material_is_taken(shop, tmp_path):
    unknown = RunFolder(shutil.copytree(shop / "run", tmp_path / "unknown"))
    found, summary = load_reconstruction(unknown).object, unknown.read_summary()
    write_json(unknown.config, unknown.read_config() | {"prior": MaterialPrior.unknown().as_dict()})
    write_object(unknown.object, found)
    unknown.write_summary(summary)  # of the settings as they are now
    options = ["--scan", shop / "scan.nxs", "--steps", 1]
    assert "what the run estimated" in worked(holosplat("surface", unknown.path, "--out", tmp_path / "b", *options)).err
    known = worked(holosplat("surface", shop / "run", "--out", tmp_path / "c", *options))
    assert "run estimated" not in known.err


def test_a_run_with_delta_and_beta_apart_is_refused(shop, tmp_path):
    apart = RunFolder(shutil.copytree(shop / "run", tmp_path / "apart"))
    write_object(apart.object, freed(load_reconstruction(apart).object))
    apart.write_summary(apart.read_summary())  # which names the object
    out = tmp_path / "bodies"
    command = holosplat("surface", apart.path, "--scan", shop / "scan.nxs", "--out", out)
    refused(command, "surfaces need one material", "δ and β apart", "--material")
    assert not out.exists()


def test_a_cloud_of_two_channels_is_refused(shop):
    cloud = load_reconstruction(RunFolder(shop / "run")).object
    with pytest.raises(InputError, match="δ and β apart"):
        extract_surfaces(freed(cloud), read_scan(shop / "scan.nxs"))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--level", "1.5"], ["level must lie between 0.01 and 0.99", "1.5"]),
        (["--spacing", "0"], ["spacing must be a positive number"]),
        (["--steps", "-1"], ["steps must not be negative"]),
        (["--rate", "0"], ["rate must be a positive number"]),
        (["--least-volume", "1e6"], ["no body of 1e+06 voxels"]),
        (["--truth", "nowhere.h5"], ["nowhere.h5"]),
        (["--scan", "nowhere.nxs"], ["nowhere.nxs"]),
    ],
)
def test_bad_options_are_refused_and_leave_nothing(shop, tmp_path, options, words):
    refused(holosplat("surface", shop / "run", "--out", tmp_path / "bodies", *options), *words)
    assert list(tmp_path.iterdir()) == []


def test_folders_that_do_not_fit_are_refused(shop, tmp_path):
    refused(holosplat("surface", tmp_path, "--out", tmp_path / "b"), "must hold a reconstruction")
    refused(holosplat("surface", shop / "run", "--out", shop), "must be new")
    refused(holosplat("surface", shop / "run", "--out", tmp_path / "none/b"), "existing folder")
    moved = Path(shutil.copytree(shop / "run", tmp_path / "moved"))
    (moved / "source.json").write_text(json.dumps({"scan": "gone.nxs"}))
    refused(holosplat("surface", moved, "--out", tmp_path / "b"), "gone.nxs", "--scan")


def test_ctrl_c_leaves_nothing(shop, tmp_path, monkeypatch):
    def interrupted(*arguments: object) -> None:
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr("holosplat.cli.track.refine_surfaces", interrupted)
    outcome = holosplat("surface", shop / "run", "--out", tmp_path / "bodies")
    assert outcome.code == 130
    assert "interrupted" in outcome.err
    assert list(tmp_path.iterdir()) == []
