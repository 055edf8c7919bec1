"""Run folders: what they hold, interruption and resumption."""

from __future__ import annotations

import csv
import hashlib
import json
import math
import signal
from dataclasses import asdict, replace

import h5py
import numpy as np
import pytest
import torch
from holosplat.workflows.settings import MaterialPrior, Settings, from_plain, preset, presets, read_settings

import holosplat.workflows.reconstruct as module
from helpers.runs import CELL, KNOWN, PIXEL, RANDOM, SMALL, STEPS, Interruption
from holosplat.checks import InputError
from holosplat.fit.loop import FitOptions
from holosplat.fit.schedule import Schedule
from holosplat.fit.trainable import Trainable
from holosplat.materials import DeltaBeta
from holosplat.model import Instrument
from holosplat.representations.gaussians import PARAMETERS
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
    with h5py.File(folder.gaussians) as file:
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
    names = {"config.json", "metrics.csv", "checkpoint.pt", "gaussians.h5", "summary.json"}
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
    assert summary["detector"] == {"rows": 40, "columns": 48, "pixel_size_m": PIXEL}
    assert summary["material"] == {"delta": CELL.delta, "beta": CELL.beta, "single": True}
    assert summary["gaussians"] == len(gaussians(whole)["centres"])
    rows = metrics(whole)
    assert [int(row["step"]) for row in rows] == list(range(1, STEPS + 1))
    assert all(float(row["loss"]) > 0 and float(row["l1"]) > 0 for row in rows)
    assert whole.history()["seconds"][-1] == pytest.approx(summary["timing_s"]["fit"], rel=1e-4)


def test_a_run_folder_gives_the_reconstruction_back(scan, whole):
    loaded, again = load_reconstruction(whole), reconstruct(scan, KNOWN, SMALL, seed=3)
    for a, b in zip(loaded.cloud.parameters, again.cloud.parameters):
        assert np.array_equal(a.numpy(), b.numpy())
    assert (loaded.cloud.unit_length, loaded.cloud.delta, loaded.cloud.beta) == (PIXEL, *CELL)
    assert (loaded.oversample, loaded.finished) == (again.oversample, True)
    assert loaded.timing.keys() == again.timing.keys()


def test_settings_go_round_through_config_json(whole):
    saved = json.loads(whole.config.read_text())["settings"]
    assert from_plain(Settings, saved, "settings") == SMALL
    assert read_settings(whole.config) == SMALL
    for settings in presets().values():
        assert from_plain(Settings, json.loads(json.dumps(asdict(settings))), "settings") == settings


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda s: s.update(speed=3), "settings has the unknown entries speed"),
        (lambda s: s["fit"]["schedule"].update(stepz=3), r"settings\.fit\.schedule has the unknown entries stepz"),
        (lambda s: s["fit"].pop("density"), r"settings\.fit lacks the entries density"),
        (
            lambda s: s["fit"]["schedule"].update(steps="many"),
            r"settings\.fit\.schedule\.steps must be of the type int",
        ),
        (lambda s: s.update(start="guess"), r"settings\.start must be one of phase, random"),
        (lambda s: s.update(volume=4), r"settings\.volume must be a table"),
        (lambda s: s["fit"]["schedule"].update(steps=-1), "steps must not be negative"),
        (lambda s: s["fit"]["schedule"].update(decay=0.0), "decay"),
        (lambda s: s["fit"]["schedule"].update(volume_edge=1), "volume_edge"),
        (lambda s: s["volume"].update(iterations=0), "iterations"),
        (lambda s: s["volume"].update(weight=-0.1), "weight"),
        (lambda s: s.update(spacing_px=0), "spacing_px"),
        (lambda s: s.update(random_count=0), "random_count"),
    ],
)
def test_settings_that_are_none_are_refused(tmp_path, change, message):
    values = asdict(SMALL)
    change(values)
    path = tmp_path / "settings.json"
    path.write_text(json.dumps(values))
    with pytest.raises(InputError, match=message):
        read_settings(path)


def test_an_unknown_preset_is_refused():
    with pytest.raises(InputError, match=r"preset must be one of default, fast, thesis.*'quick'"):
        preset("quick")


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
def test_the_same_seed_gives_the_same_run(request, scan, tmp_path, settings):
    reference = request.getfixturevalue("whole" if settings is SMALL else "random_whole")
    folder = RunFolder(tmp_path / "run")
    reconstruct(scan, KNOWN, settings, seed=3, folder=folder)
    assert_same_result(folder, reference)
    assert len(metrics(folder)) == STEPS


@pytest.mark.parametrize(
    "settings",
    [
        replace(SMALL, fit=FitOptions(schedule=Schedule(steps=2, views_per_step=1))),
        replace(RANDOM, fit=FitOptions(schedule=Schedule(steps=1, rate_position=0.0))),
    ],
    ids=["views drawn", "random start"],
)
def test_another_seed_gives_another_run_where_anything_is_random(scan, settings):
    first, other = (reconstruct(scan, KNOWN, settings, seed=seed).cloud.centres for seed in (3, 4))
    assert not torch.equal(first, other)


def test_the_result_is_the_best_state_by_the_validation_views(scan, tmp_path):
    """Not the last one, where the fit has got worse (at rates far too high)."""
    hasty = Schedule(STEPS, rate_position=2, rate_amplitude=2, decay=1, validation_views=2, validate_every=1)
    folder = RunFolder(tmp_path / "run")
    result = reconstruct(scan, KNOWN, replace(RANDOM, fit=FitOptions(schedule=hasty)), folder=folder)
    summary = json.loads(folder.summary.read_text())
    assert summary["best_step"] < summary["steps"] == STEPS
    state = folder.load_checkpoint()["fit"]
    for found, best, last in zip(result.cloud.parameters, state["best"][2], state["trainable"]["parameters"]):
        assert torch.equal(found, best)
        assert not torch.equal(found, last)
    assert np.array_equal(gaussians(folder)["centres"], result.cloud.centres.numpy())


# --- interruption and resumption ----------------------------------------------------------------------------


@pytest.mark.parametrize("settings", [SMALL, RANDOM], ids=["phase", "random"])
def test_an_interrupted_run_is_usable_and_goes_on_as_if_nothing_had_happened(request, scan, tmp_path, settings):
    reference = request.getfixturevalue("whole" if settings is SMALL else "random_whole")
    folder, stop = RunFolder(tmp_path / "run"), Interruption(after=5)
    half = reconstruct(scan, KNOWN, settings, seed=3, folder=folder, on_progress=stop)
    assert not half.finished
    assert stop.stages[-1] == "interrupted"
    loaded = load_reconstruction(folder)
    assert (loaded.finished, len(loaded.cloud)) == (False, len(half.cloud))
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


@pytest.mark.parametrize("where", [(Instrument, "frames"), (Trainable, "apply")], ids=["before", "after the step"])
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

    monkeypatch.setattr(*where, pressed)
    assert not reconstruct(scan, KNOWN, RANDOM, seed=3, folder=folder).finished
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    monkeypatch.setattr(*where, original)
    steps = [int(row["step"]) for row in metrics(folder)]
    assert steps == list(range(1, len(steps) + 1))
    assert json.loads(folder.summary.read_text())["steps"] == len(steps) < STEPS
    reconstruct(scan, KNOWN, RANDOM, seed=3, folder=folder, resume=True)
    assert_same_result(folder, random_whole)


def test_a_run_that_died_goes_on_from_its_last_checkpoint(scan, random_whole, tmp_path, monkeypatch):
    """Without a chance to tidy up: metrics.csv then holds rows beyond the checkpoint, which are written anew."""
    monkeypatch.setattr(module, "CHECKPOINT_SECONDS", 0.0)
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
    assert not folder.gaussians.exists()
    reconstruct(scan, KNOWN, SMALL, seed=3, folder=folder, resume=True)
    assert_same_result(folder, whole)


@pytest.mark.parametrize(
    ("what", "change"),
    [
        ("settings", lambda a: {**a, "settings": replace(SMALL, spacing_px=1.4)}),
        ("(prior|material)", lambda a: {**a, "prior": MaterialPrior.known(DeltaBeta(CELL.delta, 1.01 * CELL.beta))}),
        ("seed", lambda a: {**a, "seed": 4}),
        ("scan", lambda a: {**a, "scan": replace(a["scan"], frames=a["scan"].frames + np.float32(1e-3))}),
        ("scan", lambda a: {**a, "scan": replace(a["scan"], is_test=~a["scan"].is_test)}),
    ],
)
def test_resuming_with_something_else_is_refused(scan, whole, what, change):
    before = contents(whole)
    arguments = change({"scan": scan, "prior": KNOWN, "settings": SMALL, "seed": 3})
    with pytest.raises(InputError, match=rf"--resume needs the {what}.* that .* was started with"):
        reconstruct(**arguments, folder=whole, resume=True)
    assert contents(whole) == before


def test_a_damaged_checkpoint_is_refused(scan, tmp_path):
    folder = RunFolder(tmp_path / "run")
    reconstruct(scan, KNOWN, RANDOM, folder=folder, on_progress=Interruption(2))
    folder.checkpoint.write_bytes(folder.checkpoint.read_bytes()[:1000])
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
        replace(scan, exposures=replace(exposures, views=replace(views, pixel_size=3.3e-6))),
        replace(scan, exposures=replace(exposures, views=views[[1, 0, 2, 3, 4, 5, 6, 7]])),
    ]
    prints = [scan_hash(s) for s in (scan, *others)]
    assert len(set(prints)) == len(prints)
    assert scan_hash(replace(scan, provenance={"by": "somebody"})) == prints[0]
