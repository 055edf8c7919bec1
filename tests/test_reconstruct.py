"""Reconstruction end to end: quality, run folders, interruption and resumption, priors, evaluation."""

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

import holosplat.workflows.reconstruct as module
from holosplat import native
from holosplat.baselines import HolographicTV
from holosplat.beamline.simulate import simulate
from holosplat.checks import InputError
from holosplat.fit.density import DensityControl
from holosplat.fit.loop import FitOptions
from holosplat.fit.objective import Objective
from holosplat.fit.schedule import Schedule
from holosplat.fit.trainable import Trainable
from holosplat.geometry import Grid, Views
from holosplat.materials import HAEMOGLOBIN, DeltaBeta
from holosplat.model.instrument import Instrument, measure
from holosplat.representations import GaussianCloud
from holosplat.representations.gaussians import PARAMETERS, raw_of
from holosplat.scan import Exposures, Scan
from holosplat.specimens.red_cells import random_cells
from holosplat.specimens.scene import MeshScene
from holosplat.volume import Volume
from holosplat.workflows.evaluate import evaluate, material_found, render
from holosplat.workflows.provenance import scan_hash
from holosplat.workflows.reconstruct import Reconstruction, load_reconstruction, reconstruct
from holosplat.workflows.run_folder import RunFolder
from holosplat.workflows.settings import MaterialPrior, Settings, from_plain, preset, presets, read_settings
from holosplat.workflows.start import starting_cloud

PIXEL = 3.2e-6
SHAPE = (40, 48)
CELL = HAEMOGLOBIN.delta_beta(20)
KNOWN = MaterialPrior.known(CELL)
STEPS = 12

SMALL = Settings(
    spacing_px=1.5,
    approximate_steps=10,
    volume=HolographicTV(iterations=40, corrections=3, inner=10),
    fit=FitOptions(Objective(tv_volume=0.05, overfull=10.0), Schedule(steps=STEPS)),
)
RANDOM = Settings(
    start="random",
    random_count=150,
    fit=FitOptions(
        Objective(l1=1.0, ssim=0.2, frc=0.1, tv_volume=0.01),
        Schedule(steps=STEPS, views_per_step=2, validation_views=1, validate_every=4, volume_edge=12),
        DensityControl(every=3, start=0.0, stop=0.9, grow_fraction=0.1),
    ),
)
"""A fit in which everything is drawn at random that can be."""


def scene() -> MeshScene:
    box = (SHAPE[1] * PIXEL, SHAPE[0] * PIXEL, SHAPE[1] * PIXEL)
    return MeshScene.of_one_material(random_cells(6, box, 1, 14 * PIXEL), CELL)


@pytest.fixture(scope="module")
def scan() -> Scan:
    """Eight noise-free views of six red cells, two of them held out."""
    scan = simulate(scene(), Exposures.of(Views.evenly_spaced(8, SHAPE, PIXEL), 20.0, 0.1))
    assert scan.is_test.sum() == 2
    return scan


@pytest.fixture(scope="module")
def truth() -> Volume:
    return scene().voxelise(Grid.of_views(Views.evenly_spaced(8, SHAPE, PIXEL)))


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


class Interruption:
    """A progress that presses Ctrl-C (or breaks down) after a step of the fit."""

    def __init__(self, after: int, error: type[BaseException] = KeyboardInterrupt) -> None:
        self.after, self.error, self.stages = after, error, []

    def __call__(self, stage: str, fraction: float, record: dict[str, float]) -> None:
        self.stages.append(stage)
        if stage == "fit" and record["step"] == self.after:
            raise self.error


# --- quality ------------------------------------------------------------------------------------------------


def test_cells_of_known_material_are_reconstructed(scan, truth):
    """The fast preset: held-out views are predicted, and the cells lie where they are."""
    told: list[tuple[str, float]] = []
    result = reconstruct(scan, KNOWN, preset("fast"), on_progress=lambda *step: told.append(step[:2]))
    scores = evaluate(result, scan, truth)
    assert scores.test.mean["ssim"] > 0.9
    assert scores.test.mean["frcm"] > 0.88
    assert scores.train.mean["ssim"] > 0.98
    assert scores.volume.dice > 0.95
    assert scores.volume.relative_error_delta < 0.18
    assert abs(scores.volume.delta_deviation) < 0.1
    assert result.finished
    assert result.oversample == 2
    assert (result.cloud.delta, result.cloud.beta) == CELL
    stages = list(dict.fromkeys(stage for stage, _ in told))
    assert stages[0] == "phase retrieval"
    assert stages[-1] == "fit"
    assert told[-1] == ("fit", 1.0)
    assert all(0 <= fraction <= 1 for _, fraction in told)
    assert result.timing.keys() == {"start", "fit"}
    assert all(seconds > 0 for seconds in result.timing.values())


def test_held_out_frames_are_never_read(scan):
    """Poisoned with huge values, they change nothing at all, from the start on."""
    frames = np.where(scan.is_test[:, None, None], np.float32(1e30), scan.frames)
    poisoned = replace(scan, frames=frames)
    for settings, prior in ((SMALL, KNOWN), (SMALL, MaterialPrior()), (RANDOM, KNOWN)):
        a, b = (reconstruct(s, prior, settings).cloud for s in (scan, poisoned))
        assert all(np.array_equal(p.numpy(), q.numpy()) for p, q in zip(a.parameters, b.parameters))


def test_a_scan_without_training_frames_is_refused(scan, tmp_path):
    folder = RunFolder(tmp_path / "run")
    with pytest.raises(InputError, match="no training frame"):
        reconstruct(replace(scan, is_test=np.ones(8, dtype=bool)), KNOWN, SMALL, folder=folder)
    assert not folder.path.exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda s: s.binned(4), "11 rows and columns"),
        (lambda s: replace(s, frames=3000 * s.frames), "flat field"),
        (lambda s: replace(s, frames=s.frames - 1), "flat field"),
    ],
    ids=["small", "counts", "contrast"],
)
def test_frames_that_cannot_be_fitted_are_refused(scan, tmp_path, change, message):
    with pytest.raises(InputError, match=message):
        reconstruct(change(scan), KNOWN, SMALL, folder=RunFolder(tmp_path / "run"))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("settings", [SMALL, RANDOM], ids=["phase", "random"])
def test_an_empty_field_is_refused_and_leaves_no_folder(scan, tmp_path, settings):
    empty, folder = replace(scan, frames=np.ones_like(scan.frames)), RunFolder(tmp_path / "run")
    with pytest.raises(InputError, match=r"no matter|constant"):
        reconstruct(empty, KNOWN, settings, folder=folder)
    assert not folder.path.exists()


# --- priors and starts --------------------------------------------------------------------------------------


def test_with_the_ratio_alone_delta_is_found(scan, truth):
    result = reconstruct(scan, MaterialPrior.of_ratio(CELL.ratio), SMALL)
    found = evaluate(result, scan, truth)
    assert found.material.single_material
    assert found.material.ratio == pytest.approx(CELL.ratio)
    assert found.material.delta == pytest.approx(CELL.delta, rel=0.25, abs=0)
    assert found.volume.dice > 0.93
    assert "one for all" in found.lines()[-1]


@pytest.mark.parametrize("separate", [False, True])
def test_with_nothing_known_delta_and_beta_are_found(scan, truth, separate):
    """At the one ratio that the frames suggest, or fitted apart; nothing bounds the occupancy then."""
    result = reconstruct(scan, MaterialPrior(), replace(SMALL, separate=separate))
    found = evaluate(result, scan, truth)
    assert found.material.single_material != separate
    assert result.cloud.raw_amplitudes.shape[1] == 1 + separate
    assert found.material.delta == pytest.approx(CELL.delta, rel=0.35, abs=0)
    assert CELL.ratio / 2.5 < found.material.ratio < 2.5 * CELL.ratio
    assert found.volume.dice > 0.92
    assert f"δ {found.material.delta:.3e}" in found.lines()[-1]
    assert ("found apart" if separate else "one for all") in found.lines()[-1]


@pytest.mark.parametrize("prior", [KNOWN, MaterialPrior()], ids=lambda p: p.kind)
def test_the_occupancy_is_bounded_only_where_one_means_something(scan, prior):
    weights = Objective(tv_volume=0.05, overfull=10.0, two_levels=1.0)
    settings = replace(SMALL, fit=FitOptions(weights, Schedule(steps=2)))
    recorded: set[str] = set()
    result = reconstruct(scan, prior, settings, on_progress=lambda stage, part, record: recorded.update(record))
    assert result.cloud.single_material
    assert "tv_volume" in recorded
    assert ({"overfull", "two_levels"} <= recorded) == (prior.kind == "known")


@pytest.mark.parametrize(("prior", "upper"), [(KNOWN, 1.0), (MaterialPrior(), 0.0)], ids=["known", "free"])
def test_so_is_the_occupancy_of_the_start(scan, monkeypatch, prior, upper):
    begun: list[HolographicTV] = []

    def begin(scan, material, options, on_progress):
        begun.append(options)
        raise KeyboardInterrupt

    monkeypatch.setattr("holosplat.workflows.start.holographic_tv", begin)
    with pytest.raises(KeyboardInterrupt):
        starting_cloud(scan.train(), prior, SMALL, 0, lambda stage, part: None)
    assert [options.upper for options in begun] == [upper]


def test_noisy_frames_get_fewer_and_larger_gaussians(scan):
    noisy = replace(scan, frames=scan.frames + np.random.default_rng(0).normal(0, 0.02, scan.frames.shape).astype("f4"))
    clouds = [
        starting_cloud(noisy.train(), KNOWN, replace(SMALL, spacing_noise=rule), 0, lambda stage, part: None)
        for rule in (0.0, 2.3)
    ]
    assert len(clouds[1]) < 0.5 * len(clouds[0])
    assert float(clouds[1].scales.median()) > 1.3 * float(clouds[0].scales.median())


@pytest.mark.parametrize("prior", [KNOWN, MaterialPrior.of_ratio(2800.0), MaterialPrior()], ids=lambda p: p.kind)
def test_a_random_start_runs_with_every_prior(scan, prior):
    settings = replace(RANDOM, fit=FitOptions(schedule=Schedule(steps=3)))
    result = reconstruct(scan, prior, settings)
    assert len(result.cloud) == 150
    assert result.cloud.single_material == (prior.kind != "free")
    assert result.cloud.delta > 0
    if prior.kind == "ratio":
        assert result.cloud.delta / result.cloud.beta == pytest.approx(2800)


def test_too_many_gaussians_become_larger_ones(scan):
    few = replace(SMALL, max_start=400, fit=FitOptions(schedule=Schedule(steps=1)))
    many = replace(few, max_start=10_000)
    counts = [len(reconstruct(scan, KNOWN, settings).cloud) for settings in (few, many)]
    assert counts[0] <= 400 < counts[1]


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


# --- evaluation ---------------------------------------------------------------------------------------------


def a_result() -> Reconstruction:
    """Two wide Gaussians far apart."""
    centres, log_scales = torch.tensor([[-12.0, 0, 0], [12.0, 0, 0]]), torch.full((2, 3), math.log(3))
    quaternions, raw = torch.tensor([[1.0, 0, 0, 0]]).repeat(2, 1), raw_of(torch.full((2, 1), 0.8))
    return Reconstruction(GaussianCloud((centres, log_scales, quaternions, raw), PIXEL, *CELL), 20.0, 2, {}, True)


def test_rendered_frames_are_measured_ones(scan):
    result = a_result()
    wanted = measure(result.cloud, scan.exposures, 2).detach().numpy()
    np.testing.assert_allclose(render(result, scan.exposures), wanted, rtol=0, atol=1e-5)


def test_frames_of_another_energy_are_not_rendered(scan):
    """δ and β belong to one energy."""
    with pytest.raises(InputError, match=r"20 keV.*25 keV"):
        render(a_result(), replace(scan.exposures, energy_kev=25.0))


def test_scores_are_taken_on_the_right_frames_and_grid(scan, truth):
    """Frames of the cloud itself are predicted perfectly, and its own volume is the truth's equal."""
    result = a_result()
    frames = render(result, scan.exposures)
    frames[0, 0, 0] += 0.5  # a training frame
    own = replace(scan, frames=frames)
    grid = Grid.centred((20, 30, 40), 1.2 * PIXEL)
    scores = evaluate(result, own, result.cloud.voxelise(grid))
    assert scores.test.mean["ssim"] == pytest.approx(1)
    assert scores.train.mean["l1"] > 0
    assert scores.volume.relative_error_delta == 0
    assert scores.volume.dice == 1
    assert scores.predicted.shape == (2, *SHAPE)
    assert scores.test.data_range == (own.train().frames.min(), own.train().frames.max())
    assert evaluate(result, None, truth).test is None
    frames[3, 0, 0] += 5  # a held-out one
    assert evaluate(result, replace(own, frames=frames), None).test.data_range == scores.test.data_range
    only_training = evaluate(result, own.train(), None)
    assert (only_training.test, only_training.volume, only_training.predicted) == (None, None, None)


def test_an_evaluation_is_plain_json(scan, truth):
    scores = evaluate(a_result(), scan, truth)
    values = json.loads(json.dumps(scores.as_dict(), allow_nan=False))
    assert values["ssim"] == scores.test.mean["ssim"]
    assert values["dice"] == scores.volume.dice
    assert values["material"] == {"delta": CELL.delta, "ratio": CELL.ratio, "single_material": True}
    assert values["train"]["mean"]["ssim"] == scores.train.mean["ssim"]
    assert [line.split(":")[0] for line in scores.lines()] == [
        "held-out frames",
        "training frames",
        "volume",
        "material",
    ]


def test_the_material_of_a_free_cloud_is_that_of_its_matter():
    """Most matter has the ratio 4, some the ratio 1; a faint halo of another ratio must not tip the balance."""
    amplitudes = torch.tensor([[0.8, 0.2], [0.8, 0.8], [0.05, 0.5], [1e-5, 1e-5], [1e-5, 1e-5]])
    sigmas = torch.tensor([3.43, 3.0, 7.1, 1.0, 1.0])  # 45, 30 and 25 % of the mass; the last two mark the corners
    centres = torch.tensor([[0.0, -25, 0], [0, 0, 0], [0, 35, 0], [-18, -40, -18], [18, 60, 18]])
    quaternions = torch.tensor([[1.0, 0, 0, 0]]).repeat(5, 1)
    cloud = GaussianCloud((centres, sigmas.log()[:, None].repeat(1, 3), quaternions, raw_of(amplitudes)), PIXEL, *CELL)
    found = material_found(cloud)
    assert not found.single_material
    assert found.ratio == pytest.approx(4 * CELL.ratio, rel=0.01)
    assert 0.1 * CELL.delta < found.delta < 0.8 * CELL.delta


def test_a_backend_is_refused_before_the_start(scan):
    told = []
    settings = replace(RANDOM, fit=replace(RANDOM.fit, backend="tpu"))
    with pytest.raises(InputError, match="backend must be one of"):
        reconstruct(scan, KNOWN, settings, on_progress=lambda *step: told.append(step))
    assert told == []


def test_another_backend_goes_on_and_judges(scan, tmp_path):
    """What the last part of a run was computed with is what its result is read for."""
    folder = RunFolder(tmp_path / "run")
    reconstruct(scan, KNOWN, RANDOM, seed=3, folder=folder, on_progress=Interruption(2))
    plain = replace(RANDOM, fit=replace(RANDOM.fit, backend="reference"))
    assert reconstruct(scan, KNOWN, plain, seed=3, folder=folder, resume=True).cloud.backend == "reference"
    assert load_reconstruction(folder).cloud.backend == "reference"
    assert json.loads(folder.summary.read_text())["backend"] == "reference"


def test_a_whole_run_needs_no_kernels_if_asked_for_the_plain_path(scan, monkeypatch):
    """From phase retrieval to the scores, with every call of the compiled library refused."""
    small = scan.binned(2)
    monkeypatch.setattr(native, "call", lambda *_: pytest.fail("a kernel was called"))
    tiny = replace(SMALL.volume, backend="reference", refine=1, iterations=3, corrections=1, inner=2)
    schedule = replace(SMALL.fit.schedule, steps=2, oversample=1)
    plain = replace(
        SMALL, volume=tiny, approximate_steps=2, fit=replace(SMALL.fit, schedule=schedule, backend="reference")
    )
    done = reconstruct(small, KNOWN, plain)
    assert done.finished
    assert math.isfinite(evaluate(done, small, None).test.mean["ssim"])
