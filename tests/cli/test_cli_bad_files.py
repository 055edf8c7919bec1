"""Bad scenes, meshes, runs, truths and volumes: what the command line says and leaves behind."""

from __future__ import annotations

import shutil

import h5py
import numpy as np
import pytest

from helpers.cli import altered, copied, everything_in, holosplat, put, refused, truncated
from holosplat.io.vtk import read_meshes, write_mesh
from holosplat.mesh import TriangleMesh

BAD_SCENES: dict[str, tuple[list[str], list[str]]] = {
    "unknown length unit": (altered("--length-unit", "furlong"), ["furlong", "um"]),
    "bad formula": (altered("--material", "Xx2"), ["material", "Xx2"]),
    "formula without density": (altered("--material", "H2O"), ["H2O", "density"]),
    "negative density": (altered("--material", "H2O", "--density", "-1"), ["density", "positive"]),
    "medium's density alone": (altered("--medium-density", "1"), ["--medium-density", "--medium"]),
    "no energy": (altered("--energy-kev", "0"), ["energy", "positive", "keV"]),
    "negative energy": (altered("--energy-kev", "-20"), ["--energy-kev must not be negative", "-20"]),
    "energy in eV": (altered("--energy-kev", "20000"), ["energy", "20000", "unit"]),
    "negative distance": (altered("--distance", "-0.1"), ["--distance must not be negative", "-0.1"]),
    "infinite distance": (altered("--distance", "inf"), ["--distance must be a finite number", "inf"]),
    "pixel of no size": (altered("--pixel-size", "0"), ["--pixel-size", "positive"]),
    "negative pixel": (altered("--pixel-size", "-3.2e-6"), ["--pixel-size", "positive", "-3.2e-06"]),
    "pixel of metres": (altered("--pixel-size", "3.2"), ["--pixel-size", "3.2", "metres"]),
    "no rows": (altered("--detector", "0 28"), ["--detector", "at least 1", "0"]),
    "negative rows": (altered("--detector", "-24 28"), ["--detector", "at least 1", "-24"]),
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
    (tmp_path / "half/object.h5").unlink()
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
        ("object.h5", lambda path: truncated(path, path.parent), ["object.h5", "truncated"]),
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


def test_an_archive_that_was_cut_off_is_called_damaged(tmp_path):
    np.savez(tmp_path / "whole.npz", counts=np.ones((3, 20, 20)))
    (tmp_path / "cut").mkdir()
    cut = truncated(tmp_path / "whole.npz", tmp_path / "cut")
    refused(holosplat("retrieve", cut, "--delta-beta", "1000", "--out", tmp_path / "out.h5"), "whole.npz", "damaged")


def test_text_is_no_hdf5_file(tmp_path):
    (tmp_path / "text.nxs").write_text("hello")
    refused(holosplat("check", tmp_path / "text.nxs"), "text.nxs", "does not start like one")


def test_bad_truths_are_refused(shop, tmp_path):
    half = truncated(shop.truth, tmp_path)
    refused(holosplat("evaluate", shop.run, "--truth", half), "truth.h5", "truncated")
    refused(holosplat("evaluate", shop.run, "--truth", tmp_path / "none.h5"), "none.h5", "no such file")
    refused(holosplat("evaluate", shop.run, "--truth", shop.scan), "whose name ends with .h5")
    other = shutil.copy(shop.scan, tmp_path / "scan.h5")
    refused(holosplat("evaluate", shop.run, "--truth", other), "/delta", "missing")


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
        (["--voxel-size", "-1e-6"], ["--voxel-size", "must not be negative", "-1e-06"]),
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
