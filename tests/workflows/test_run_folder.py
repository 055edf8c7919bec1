"""Run folders: what they hold, interruption and resumption."""

from __future__ import annotations

import csv
import hashlib
import json
import math
import signal
from dataclasses import replace

import h5py
import numpy as np
import pytest
import torch

from helpers.runs import CELL, KNOWN, PIXEL, RANDOM, SMALL, STEPS, Interruption
from holosplat.checks import InputError
from holosplat.fit import run as engine
from holosplat.fit.optimiser import Adam
from holosplat.fit.problem import Schedule
from holosplat.matter import DeltaBeta, MaterialPrior, Matter
from holosplat.methods import FitOptions, GaussianRates, Gaussians
from holosplat.methods.presets import read_method
from holosplat.model import Instrument
from holosplat.optics.background import LightOptions
from holosplat.representations.gaussians import PARAMETERS
from holosplat.tables import from_table
from holosplat.workflows.evaluate import evaluate
from holosplat.workflows.provenance import scan_hash
from holosplat.workflows.reconstruct import load_reconstruction, reconstruct
from holosplat.workflows.run_folder import RunFolder


def contents(folder: RunFolder) -> dict[str, str]:
    """Fingerprints of all files of a folder."""
    return {p.name: hashlib.sha256(p.read_bytes()).hexdigest() for p in sorted(folder.path.iterdir())}


def metrics(folder: RunFolder) -> list[dict[str, str]]:
    """The rows of metrics.csv without the clock."""
    with folder.metrics.open(newline="") as file:
        return [{k: v for k, v in row.items() if k != "seconds"} for row in csv.DictReader(file)]


def gaussians(folder: RunFolder) -> dict[str, np.ndarray]:
    with h5py.File(folder.object) as file:
        return {name: file[name][()] for name in PARAMETERS}


def assert_same_result(a: RunFolder, b: RunFolder) -> None:
    """Bit for bit the same Gaussians, and the same metrics."""
    for name, array in gaussians(a).items():
        np.testing.assert_array_equal(gaussians(b)[name], array, err_msg=name)
    assert metrics(a) == metrics(b)


# --- the run folder -----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def whole(scan, tmp_path_factory) -> RunFolder:
    """A finished run with a phase start."""
    folder = RunFolder(tmp_path_factory.mktemp("whole") / "run")
    reconstruct(scan, KNOWN, SMALL, seed=3, folder=folder)
    return folder


@pytest.fixture(scope="module")
def random_whole(scan, tmp_path_factory) -> RunFolder:
    """A finished run in which everything is drawn at random."""
    folder = RunFolder(tmp_path_factory.mktemp("random") / "run")
    reconstruct(scan, KNOWN, RANDOM, seed=3, folder=folder)
    return folder


def test_a_run_folder_holds_what_was_done(scan, whole):
    names = {"config.json", "metrics.csv", "checkpoint.pt", "checkpoint_before.pt", "object.h5", "summary.json"}
    names |= {"manifest.json"}
    assert set(contents(whole)) == names
    config = json.loads(whole.config.read_text())
    assert config["seed"] == 3
    assert config["prior"] == {"kind": "known", "delta": CELL.delta, "beta": CELL.beta, "ratio": 0.0}
    assert config["scan_hash"] == scan_hash(scan)
    assert {"holosplat", "python", "torch", "numpy"} <= set(config["versions"])
    assert config["machine"]["backend"] == "cpu"
    summary = json.loads(whole.summary.read_text())
    assert summary["finished"] is True
    assert (summary["steps"], summary["best_step"]) == (STEPS, STEPS)
    assert summary["detector"] == {"rows": 40, "columns": 48, "pixel_size_m": PIXEL, "centre_m": [0.0, 0.0, 0.0]}
    assert summary["material"] == {"delta": CELL.delta, "beta": CELL.beta, "single": True, "delta_told": True}
    assert (summary["method"], summary["kind"]) == ("gaussians", "gaussians")
    assert summary["size"] == f"{len(gaussians(whole)['centres'])} Gaussians"
    rows = metrics(whole)
    assert [int(row["step"]) for row in rows] == list(range(1, STEPS + 1))
    assert all(float(row["loss"]) > 0 and float(row["l1"]) > 0 for row in rows)
    assert whole.history()["seconds"][-1] == pytest.approx(summary["timing_s"]["fit"], rel=1e-4)


def test_a_run_folder_gives_the_reconstruction_back(scan, whole):
    loaded, again = load_reconstruction(whole), reconstruct(scan, KNOWN, SMALL, seed=3)
    assert loaded.object.parameters().keys() == again.object.parameters().keys()
    for name, found in loaded.object.parameters().items():
        assert torch.equal(found, again.object.parameters()[name])
    assert (loaded.object.unit_length, loaded.object.matter) == (PIXEL, Matter.one(*CELL))
    assert (loaded.oversample, loaded.finished) == (again.oversample, True)
    assert loaded.timing.keys() == again.timing.keys()


def test_options_go_round_through_config_json(whole):
    saved = json.loads(whole.config.read_text())["method"]
    assert from_table(Gaussians, saved) == SMALL
    assert read_method(whole.config) == SMALL


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda s: s["fit"]["schedule"].update(volume_edge=1), r"fit\.schedule: volume_edge must be at least 2"),
        (lambda s: s["volume"].update(weight=-0.1), "volume: weight must not be negative"),
        (lambda s: s.update(random_count=0), "random_count must be at least 1"),
        (lambda s: s["fit"].update(terms=[{"name": "none"}]), "a term must be one of .*'none'"),
    ],
)
def test_a_config_with_values_that_cannot_be_is_refused(whole, tmp_path, change, message):
    config = json.loads(whole.config.read_text())
    change(config["method"])
    path = tmp_path / "config.json"
    path.write_text(json.dumps(config))
    with pytest.raises(InputError, match=message):
        read_method(path)


def test_a_taken_folder_is_refused_and_left_alone(scan, whole, tmp_path):
    before = contents(whole)
    with pytest.raises(InputError, match="--out"):
        reconstruct(scan, KNOWN, SMALL, folder=whole)
    assert contents(whole) == before
    file = tmp_path / "file"
    file.write_text("mine")
    with pytest.raises(InputError, match="--out"):
        reconstruct(scan, KNOWN, SMALL, folder=RunFolder(file))
    assert file.read_text() == "mine"
    with pytest.raises(InputError, match="existing folder"):
        reconstruct(scan, KNOWN, SMALL, folder=RunFolder(tmp_path / "none" / "run"))
    assert not (tmp_path / "none").exists()


def test_a_folder_that_is_no_run_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"run folder .* does not exist"):
        load_reconstruction(RunFolder(tmp_path / "none"))
    with pytest.raises(InputError, match="must hold a reconstruction"):
        load_reconstruction(RunFolder(tmp_path))


@pytest.mark.parametrize("settings", [SMALL, RANDOM], ids=["phase", "random"])
def test_the_same_seed_gives_the_same_run(request, begun_once, scan, tmp_path, settings):
    reference = request.getfixturevalue("whole" if settings is SMALL else "random_whole")
    folder = RunFolder(tmp_path / "run")
    begun_once.made.clear()
    reconstruct(scan, KNOWN, settings, seed=3, folder=folder)
    assert_same_result(folder, reference)
    assert len(metrics(folder)) == STEPS


@pytest.mark.parametrize(
    "settings",
    [
        replace(SMALL, fit=FitOptions(schedule=Schedule(steps=2, views_per_step=1))),
        replace(RANDOM, fit=FitOptions(schedule=Schedule(steps=1), rates=GaussianRates(centres=0.0))),
    ],
    ids=["views drawn", "random start"],
)
@pytest.mark.usefixtures("unjudged_runs")
def test_another_seed_gives_another_run_where_anything_is_random(scan, settings):
    first, other = (reconstruct(scan, KNOWN, settings, seed=seed).object.centres for seed in (3, 4))
    assert not torch.equal(first, other)


def test_the_result_is_the_best_state_by_the_validation_views(scan, tmp_path):
    """Not the last one, where the fit has got worse (at rates far too high)."""
    hasty = FitOptions(
        schedule=Schedule(STEPS, decay=1, validation_views=2, validate_every=1),
        rates=GaussianRates(centres=2, raw_amplitudes=2),
    )
    folder = RunFolder(tmp_path / "run")
    result = reconstruct(scan, KNOWN, replace(RANDOM, fit=hasty), folder=folder)
    summary = json.loads(folder.summary.read_text())
    assert summary["best_step"] < summary["steps"] == STEPS
    state = folder.load_checkpoint()["fit"]
    best, last = state["best"][2], state["trainable"]["parameters"]
    assert set(best) == set(last)
    for name, found in result.object.parameters().items():
        assert torch.equal(found, best[f"object.{name}"])
        assert not torch.equal(found, last[f"object.{name}"])
    assert np.array_equal(gaussians(folder)["centres"], result.object.centres.numpy())


# --- interruption and resumption ----------------------------------------------------------------------------


@pytest.mark.parametrize("settings", [SMALL, RANDOM], ids=["phase", "random"])
def test_an_interrupted_run_is_usable_and_goes_on_as_if_nothing_had_happened(request, scan, tmp_path, settings):
    reference = request.getfixturevalue("whole" if settings is SMALL else "random_whole")
    folder, stop = RunFolder(tmp_path / "run"), Interruption(after=5)
    half = reconstruct(scan, KNOWN, settings, seed=3, folder=folder, on_progress=stop)
    assert not half.finished
    assert stop.stages[-1] == "interrupted"
    loaded = load_reconstruction(folder)
    assert (loaded.finished, len(loaded.object)) == (False, len(half.object))
    assert math.isfinite(evaluate(loaded, scan, None).test.mean["ssim"])
    assert json.loads(folder.summary.read_text())["steps"] == 5
    assert [int(row["step"]) for row in metrics(folder)] == [1, 2, 3, 4, 5]
    going = Interruption(after=99)
    done = reconstruct(scan, KNOWN, settings, seed=3, folder=folder, resume=True, on_progress=going)
    assert done.finished
    assert set(going.stages) == {"fit"}  # the start is not done again
    assert_same_result(folder, reference)
    assert done.timing["start"] == half.timing["start"]
    assert done.timing["fit"] > half.timing["fit"]


@pytest.mark.parametrize("where", [(Instrument, "frames"), (Adam, "apply")], ids=["before", "after the step"])
def test_ctrl_c_in_the_middle_of_a_step_does_no_harm(scan, random_whole, tmp_path, monkeypatch, where):
    """The signal comes at any time; what is saved must be the state between two steps."""
    folder, calls = RunFolder(tmp_path / "run"), []
    original = getattr(*where)

    def pressed(self, *args):
        result = original(self, *args)
        calls.append(1)
        if len(calls) == 8:
            signal.raise_signal(signal.SIGINT)
        return result

    even = {"light": LightOptions("even", noise="white")}  # else volumes that decide are made before the fit
    monkeypatch.setattr(*where, pressed)
    assert not reconstruct(scan, KNOWN, RANDOM, seed=3, folder=folder, **even).finished
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    monkeypatch.setattr(*where, original)
    steps = [int(row["step"]) for row in metrics(folder)]
    assert steps == list(range(1, len(steps) + 1))
    assert json.loads(folder.summary.read_text())["steps"] == len(steps) < STEPS
    reconstruct(scan, KNOWN, RANDOM, seed=3, folder=folder, resume=True, **even)
    assert_same_result(folder, random_whole)


def test_a_run_that_died_goes_on_from_its_last_checkpoint(scan, random_whole, tmp_path, monkeypatch):
    """Without a chance to tidy up: metrics.csv then holds rows beyond the checkpoint, which are written anew."""
    monkeypatch.setattr(engine, "CHECKPOINT_SECONDS", 0.0)
    folder = RunFolder(tmp_path / "run")
    with pytest.raises(RuntimeError):
        reconstruct(scan, KNOWN, RANDOM, seed=3, folder=folder, on_progress=Interruption(7, RuntimeError))
    columns = folder.metrics.read_text().splitlines()[0].split(",")
    with folder.metrics.open("a", newline="") as file:
        for step in (7, 8):
            csv.writer(file).writerow([step if name == "step" else 1 for name in columns])
    reconstruct(scan, KNOWN, RANDOM, seed=3, folder=folder, resume=True)
    assert_same_result(folder, random_whole)


def test_resuming_a_finished_run_changes_nothing(scan, whole, tmp_path):
    reference = gaussians(whole), metrics(whole)
    done = reconstruct(scan, KNOWN, SMALL, seed=3, folder=whole, resume=True)
    assert done.finished
    after = gaussians(whole), metrics(whole)
    assert after[1] == reference[1]
    assert all(np.array_equal(after[0][name], reference[0][name]) for name in PARAMETERS)


def test_resuming_where_nothing_is_starts_a_run(scan, whole, tmp_path):
    """Also after an interruption during the start, which leaves nothing behind."""
    folder, new = RunFolder(tmp_path / "run"), RunFolder(tmp_path / "new")
    reconstruct(scan, KNOWN, SMALL, seed=3, folder=new, resume=True)
    assert_same_result(new, whole)

    def at_the_start(stage, fraction, record):
        if stage == "tomography":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        reconstruct(scan, KNOWN, SMALL, seed=3, folder=folder, on_progress=at_the_start)
    assert not folder.object.exists()
    reconstruct(scan, KNOWN, SMALL, seed=3, folder=folder, resume=True)
    assert_same_result(folder, whole)


@pytest.mark.parametrize(
    ("what", "change"),
    [
        ("method and settings", lambda a: {**a, "method": replace(SMALL, spacing_px=1.4)}),
        ("(prior|material)", lambda a: {**a, "prior": MaterialPrior.known(DeltaBeta(CELL.delta, 1.01 * CELL.beta))}),
        ("seed", lambda a: {**a, "seed": 4}),
        ("scan", lambda a: {**a, "scan": replace(a["scan"], frames=a["scan"].frames + np.float32(1e-3))}),
        ("scan", lambda a: {**a, "scan": replace(a["scan"], is_test=~a["scan"].is_test)}),
    ],
)
def test_resuming_with_something_else_is_refused(scan, whole, what, change):
    before = contents(whole)
    arguments = change({"scan": scan, "prior": KNOWN, "method": SMALL, "seed": 3})
    with pytest.raises(InputError, match=rf"--resume needs the {what}.* that .* was started with"):
        reconstruct(**arguments, folder=whole, resume=True)
    assert contents(whole) == before


def test_a_damaged_checkpoint_is_refused(scan, tmp_path):
    folder = RunFolder(tmp_path / "run")
    reconstruct(scan, KNOWN, RANDOM, folder=folder, on_progress=Interruption(2))
    for path in (folder.checkpoint, folder.earlier_checkpoint):
        path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(InputError, match=r"checkpoint\.pt must be a checkpoint"):
        reconstruct(scan, KNOWN, RANDOM, folder=folder, resume=True)


def test_the_scans_fingerprint_sees_everything_that_counts(scan):
    views, exposures = scan.views, scan.exposures
    others = [
        replace(scan, frames=scan.frames * np.float32(1.001)),
        replace(scan, is_test=~scan.is_test),
        replace(scan, exposures=replace(exposures, energy_kev=20.1)),
        replace(scan, exposures=replace(exposures, distance=exposures.distance * 1.01)),
        replace(scan, exposures=replace(exposures, psf_sigma_px=exposures.psf_sigma_px + 0.1)),
        replace(scan, exposures=replace(exposures, views=replace(views, shifts=views.shifts + 1e-9))),
        replace(scan, exposures=replace(exposures, views=replace(views, pitch=3.3e-6))),
        replace(scan, exposures=replace(exposures, views=views[[1, 0, 2, 3, 4, 5, 6, 7]])),
    ]
    prints = [scan_hash(s) for s in (scan, *others)]
    assert len(set(prints)) == len(prints)
    assert scan_hash(replace(scan, provenance={"by": "somebody"})) == prints[0]
