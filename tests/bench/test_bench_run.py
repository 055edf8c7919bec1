"""The benchmark's runner: rows, what is kept and gone on with, what fails, and what it refuses."""

from __future__ import annotations

import json
import sys
from dataclasses import replace

import h5py
import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

import holosplat as hs
from helpers.bench_shop import MATERIAL, PITCH, Recorder, fail, make_case, suite, voxels
from holosplat.matter import Matter
from holosplat.optics.sampling import fringe_sampling
from holosplat.representations import SurfaceMesh, VoxelGrid
from holosplat.workflows.evaluate import score_object
from holosplat_bench.declaration import Case
from holosplat_bench.opponents.fields import NeuralField
from holosplat_bench.opponents.fields.neural_field import Network
from holosplat_bench.specimens.phantoms import star_of_balls
from holosplat_bench.suite import methods, run
from holosplat_bench.suite.folder import BenchFolder, Row, read_row, write_row
from holosplat_bench.suite.methods import REFERENCES
from holosplat_bench.suite.prepare import fingerprint, prepared
from holosplat_bench.suite.run import Suite, contrast_by_size, run_suite, stored_bytes

pytestmark = pytest.mark.usefixtures("unjudged_runs", "plain_light")

# --- rows ---------------------------------------------------------------------------------------------------


def test_every_method_gets_a_row_for_every_case_and_seed(recorder, tmp_path):
    seen: list[tuple[str, int, str, int]] = []
    folder = BenchFolder(tmp_path / "bench")
    methods = [recorder.method("one"), recorder.method("other", lambda scan: voxels(scan, 0.5))]
    run_suite(
        suite(methods, ("round", "wide"), (3, 4)),
        folder,
        on_row=lambda row, left: seen.append((row.case, row.seed, row.method, left)),
    )
    wanted = [(c, s, m) for c in ("round", "wide") for s in (3, 4) for m in ("one", "other")]
    assert [entry[:3] for entry in seen] == wanted
    assert [entry[3] for entry in seen] == list(range(7, -1, -1))
    rows = folder.read_rows()
    assert [(row.case, row.seed, row.method) for row in rows] == wanted
    assert all(row.done and row.seconds > 0 and row.when and row.machine["threads"] for row in rows)
    assert {row.family for row in rows} == {"fakes"}
    assert len({row.scan_hash for row in rows}) == 4


def test_results_are_as_large_as_files_of_them_have_to_be():
    grid, matter = hs.Grid.centred((3, 4, 5), 1e-6), Matter.one(1e-6, 1e-9)
    values, mask = torch.rand(1, *grid.shape), torch.ones(grid.shape, dtype=torch.bool)
    field = NeuralField(grid, matter, Network(hidden=8), mask, 0)
    mesh = SurfaceMesh(torch.rand(7, 3), torch.tensor([[0, 1, 2], [2, 1, 6]]), 1e-6, matter)
    assert stored_bytes(VoxelGrid(values, grid, matter)) == 2 * 60
    assert stored_bytes(field) == 2 * sum(weight.numel() for weight in field.parameters().values()) + 60 // 8
    assert stored_bytes(mesh) == 4 * 3 * (7 + 2)


def test_a_method_sees_the_training_frames_and_the_prior_only(recorder, tmp_path):
    run_suite(suite([recorder.method("one")]), BenchFolder(tmp_path / "bench"))
    ((_, scan, prior, seed),) = recorder.calls
    assert len(scan) == 4
    assert not scan.is_test.any()
    assert prior == hs.MaterialPrior.known(MATERIAL)
    assert seed == 3


def test_a_row_holds_the_scores(recorder, tmp_path):
    folder = BenchFolder(tmp_path / "bench")
    run_suite(suite([recorder.method("one")], ("wide",)), folder)
    (row,) = folder.read_rows()
    case = make_case("wide", 3)
    scan, truth = prepared(case, folder.case("wide", 3))
    scores = score_object(voxels(scan), scan, truth, fringe_sampling(scan.exposures))
    assert row.test == pytest.approx(scores.test.mean)
    assert row.train == pytest.approx(scores.train.mean)
    assert row.volume["dice"] == scores.volume.dice
    assert row.volume["resolution_half"] > row.volume["pitch"]
    picture, true = (folder.read_picture("wide", 3, name) for name in ("one", "truth"))
    assert picture["xy"].shape == true["xy"].shape == (21, 31)
    assert picture["xz"].shape == (31, 31)
    assert picture["zy"].shape == (21, 31)
    assert set(np.unique(picture["xz"])) == {0.0, 1.0}  # in units of the material
    index = int(true["index"])
    assert np.abs(picture["frame"] - scores.predicted[index]).max() < 2e-3  # half precision
    assert np.abs(true["frame"] - scan.test().frames[index]).max() < 2e-3
    assert picture["frc"] == pytest.approx(scores.test.frc.mean(axis=0))


def test_the_size_of_a_result_is_known_if_it_can_be_stored(recorder, tmp_path):
    class Plain:
        def __init__(self, obj: hs.volume.Object) -> None:
            self.at, self.project, self.voxelise = obj.at, obj.project, obj.voxelise

    folder, seen = BenchFolder(tmp_path / "bench"), list[VoxelGrid]()

    def stored(scan):
        seen.append(voxels(scan))
        return seen[-1]

    run_suite(suite([recorder.method("stored", stored), recorder.method("plain", lambda s: Plain(voxels(s)))]), folder)
    assert [row.stored_bytes for row in folder.read_rows()] == [2 * seen[0].values.numel(), None]


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="only Linux says what a process holds")
def test_memory_is_counted_to_its_peak():
    with run.memory_growth() as growth:
        np.ones(10_000_000)
        grown = growth()
    assert grown is not None
    assert 60e6 < grown < 200e6
    with run.memory_growth() as growth:
        grown = growth()
    assert grown is not None
    assert grown < 20e6


def test_unbounded_scores_are_kept(tmp_path):
    row = Row("a", 1, "m", "f", "s", 0, "done", "", "h", "c", "w", test={"psnr": float("inf")}, volume={"dice": None})
    write_row(tmp_path / "row.json", row)
    assert read_row(tmp_path / "row.json") == row
    assert "Infinity" not in (tmp_path / "row.json").read_text()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda v: v.pop("seconds"), "differs in seconds"),
        (lambda v: v.update(more=1), "differs in more"),
        (lambda v: v.update(status="perhaps"), "its entries are not"),
        (lambda v: v.update(test={"ssim": "high"}), "its entries are not"),
        (lambda v: v.update(volume=3), "its entries are not"),
    ],
)
def test_a_damaged_row_is_refused_by_name(tmp_path, change, words):
    path = tmp_path / "row.json"
    write_row(path, Row("a", 1, "m", "f", "s", 0, "done", "", "h", "c", "w", test={"ssim": 1.0}))
    values = json.loads(path.read_text())
    change(values)
    path.write_text(json.dumps(values))
    with pytest.raises(hs.InputError, match=words) as caught:
        read_row(path)
    assert str(path) in str(caught.value)


def test_contrast_by_size_is_what_is_left_of_it(recorder, tmp_path):
    """A tenth of the truth everywhere has a tenth of its contrast; a blur takes more from small balls."""
    balls = star_of_balls(np.array([6e-6, 3e-6, 1.5e-6]), seed=1, spokes=4)
    scene = hs.MeshScene.of_one_material([ball.mesh() for ball in balls], MATERIAL)
    truth = scene.voxelise(hs.Grid.centred((33, 34, 35), PITCH))
    sizes, contrast = contrast_by_size(hs.Volume(0.1 * truth.delta, truth.beta, truth.grid), truth, balls)
    assert sizes == pytest.approx([6e-6, 3e-6, 1.5e-6])
    assert contrast == pytest.approx(0.1, rel=1e-5)
    offset = hs.Volume(truth.delta + 1e-6, truth.beta, truth.grid)
    assert contrast_by_size(offset, truth, balls)[1] == pytest.approx(1.0, rel=1e-4)
    blurred = hs.Volume(gaussian_filter(truth.delta, 1.0), truth.beta, truth.grid)
    large, middle, small = contrast_by_size(blurred, truth, balls)[1]
    assert 1 > large > middle > small > 0
    folder = BenchFolder(tmp_path / "bench")
    exposures = hs.Exposures.of(hs.Views.evenly_spaced(6, (34, 36), PITCH), 20.0, 0.02)
    case = replace(make_case("round", 1), scene=scene, exposures=exposures, balls=tuple(balls), name="star")
    run_suite(suite([recorder.method("one")], ("star",), load=lambda name, seed: replace(case, seed=seed)), folder)
    assert folder.read_picture("star", 3, "one")["contrast"].shape == (3,)


# --- going on -----------------------------------------------------------------------------------------------


def test_rows_that_are_there_are_kept(recorder, tmp_path):
    folder = BenchFolder(tmp_path / "bench")
    run_suite(suite([recorder.method("one")]), folder)
    before = {path: path.stat().st_mtime_ns for path in folder.rows.iterdir()}

    def never(name, seed):
        raise AssertionError("a case of which all rows are there needs no scene")

    run_suite(suite([recorder.method("one")], load=never), folder)
    assert recorder.names == ["one"]
    run_suite(suite([recorder.method("one"), recorder.method("two")], seeds=(3, 5)), folder)
    assert recorder.names == ["one", "two", "one", "two"]
    assert all(path.stat().st_mtime_ns == time for path, time in before.items())


def test_an_interrupted_benchmark_leaves_whole_rows_and_goes_on(recorder, tmp_path):
    folder = BenchFolder(tmp_path / "bench")
    stopped = [recorder.method("one"), recorder.method("two", fail(KeyboardInterrupt())), recorder.method("three")]
    with pytest.raises(KeyboardInterrupt):
        run_suite(suite(stopped), folder)
    assert [row.method for row in folder.read_rows()] == ["one"]
    assert not list(folder.path.rglob(".*"))
    run_suite(suite([recorder.method(name) for name in ("one", "two", "three")]), folder)
    assert recorder.names == ["one", "two", "two", "three"]
    assert [row.method for row in folder.read_rows()] == ["one", "two", "three"]


def test_the_scan_is_simulated_once(recorder, tmp_path, monkeypatch):
    folder = BenchFolder(tmp_path / "bench")
    run_suite(suite([recorder.method("one")]), folder)
    monkeypatch.setattr(Case, "scan", lambda self: pytest.fail("simulated again"))
    run_suite(suite([recorder.method("one"), recorder.method("two")]), folder)
    (_, first, *_), (_, second, *_) = recorder.calls
    assert np.array_equal(first.frames, second.frames)


def test_a_half_simulated_case_is_made_again(tmp_path):
    case, folder = make_case("round", 1), tmp_path / "round.1"
    frames = prepared(case, folder)[0].frames
    (folder / "case.json").unlink()
    (folder / "scan.nxs").write_bytes(b"half of it")
    again, _ = prepared(case, folder)
    assert np.array_equal(frames, again.frames)


@pytest.mark.parametrize("part", ["scene", "material", "split", "distance", "prior", "photons"])
def test_a_case_that_has_changed_is_not_mixed_with_its_past(tmp_path, part):
    case, folder = make_case("round", 1), tmp_path / "round.1"
    prepared(case, folder)
    changed = {
        "scene": replace(case, scene=case.scene.moved(np.array([1e-9, 0, 0]))),
        "material": replace(case, scene=replace(case.scene, materials=(hs.DeltaBeta(2e-7, 1e-10),))),
        "split": replace(case, is_test=np.arange(6) == 1),
        "distance": replace(case, exposures=replace(case.exposures, distance=0.03)),
        "prior": replace(case, prior=hs.MaterialPrior.unknown()),
        "photons": replace(case, photons=1e4),
    }[part]
    assert fingerprint(make_case("round", 1)) == fingerprint(case) != fingerprint(changed)
    with pytest.raises(hs.InputError, match="holds an earlier round of seed 1"):
        prepared(changed, folder)


def test_frames_that_were_changed_are_refused(tmp_path):
    case, folder = make_case("round", 1), tmp_path / "round.1"
    prepared(case, folder)
    with h5py.File(folder / "scan.nxs", "r+") as file:
        file["entry/instrument/detector/data"][0, 0, 0] = 7.0
    with pytest.raises(hs.InputError, match="not the scan that was simulated"):
        prepared(case, folder)


# --- failures -----------------------------------------------------------------------------------------------


def test_what_fails_says_why_and_the_others_go_on(recorder, tmp_path):
    folder = BenchFolder(tmp_path / "bench")
    nan = lambda scan: voxels(scan, float("nan"))  # noqa: E731
    methods = [
        recorder.method("refuses", fail(hs.InputError("it needs a common axis, but there is none."))),
        recorder.method("breaks", fail(ZeroDivisionError("first line\nlast line"))),
        recorder.method("silent", fail(RuntimeError())),
        recorder.method("nan", nan),
        recorder.method("works"),
    ]
    run_suite(suite(methods), folder)
    refuses, breaks, silent, bad, works = folder.read_rows()
    assert refuses.reason == "it needs a common axis, but there is none."
    assert breaks.reason == "ZeroDivisionError: last line"
    assert silent.reason == "RuntimeError"
    assert "finite" in bad.reason
    assert works.done
    assert [row.status for row in (refuses, breaks, silent, bad)] == ["failed"] * 4
    assert not refuses.test
    assert folder.read_picture("round", 3, "nan") is None


def test_failures_are_kept_unless_they_shall_be_tried_again(recorder, tmp_path):
    folder = BenchFolder(tmp_path / "bench")
    run_suite(suite([recorder.method("one"), recorder.method("two", fail(ValueError("no")))]), folder)
    mended = suite([recorder.method("one"), recorder.method("two")])
    run_suite(mended, folder)
    assert recorder.names == ["one", "two"]
    run_suite(mended, folder, retry=True)
    assert recorder.names == ["one", "two", "two"]
    assert all(row.done for row in folder.read_rows())


# --- references ---------------------------------------------------------------------------------------------


def test_the_truth_on_voxels_is_the_truth(tmp_path):
    folder = BenchFolder(tmp_path / "bench")
    reference = {"truth-on-voxels": REFERENCES["truth-on-voxels"]}
    run_suite(Suite(["wide"], [3], {"m": Recorder().method("m")}, reference, make_case), folder)
    first, second = folder.read_rows()
    assert first.is_reference
    assert not second.is_reference
    assert first.volume["dice"] == 1
    assert first.volume["relative_error_delta"] < 1e-6
    assert first.volume["relative_error_beta"] < 1e-6
    assert first.test["ssim"] > max(0.8, second.test["ssim"])


def test_true_lines_are_the_true_thickness(monkeypatch):
    """What tomography is given integrates to the ball's volume in every training view."""
    given = {}

    def tomography(lines, views, grid, upper, on_progress):
        given.update(lines=lines, views=views, upper=upper)
        return torch.zeros(grid.shape)

    monkeypatch.setitem(methods.TOMOGRAPHIES, "tv", tomography)
    case = make_case("wide", 3)
    found = methods.tv_of_true_lines(case, case.truth(), lambda stage, fraction: None)
    assert found.matter == Matter.one(*MATERIAL)
    assert len(given["views"]) == 4
    assert given["upper"] == 1
    volume = case.scene.meshes[0].volume
    assert given["lines"].sum(dim=(1, 2)).numpy() * PITCH**2 == pytest.approx(volume, rel=0.01)
    with pytest.raises(hs.InputError, match="known material"):
        methods.tv_of_true_lines(replace(case, prior=hs.MaterialPrior.unknown()), case.truth(), lambda s, f: None)
