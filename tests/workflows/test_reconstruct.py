"""Reconstruction end to end: quality, priors, evaluation and backends."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from helpers.runs import CELL, KNOWN, PIXEL, RANDOM, SHAPE, SMALL, Interruption, scene
from holosplat import native
from holosplat.baselines import HolographicTV
from holosplat.checks import InputError
from holosplat.fit.problem import Schedule
from holosplat.fit.terms import Objective
from holosplat.geometry import Grid, Views
from holosplat.matter import MaterialPrior, Matter
from holosplat.methods import FitOptions, Task, Voxels
from holosplat.methods.presets import preset
from holosplat.methods.start import starting_cloud
from holosplat.model import measure
from holosplat.representations import GaussianCloud, VoxelGrid
from holosplat.representations.gaussians import raw_of
from holosplat.volume import Volume
from holosplat.workflows.evaluate import evaluate, material_found, render
from holosplat.workflows.reconstruct import Reconstruction, load_reconstruction, reconstruct
from holosplat.workflows.run_folder import RunFolder

pytestmark = pytest.mark.usefixtures("unjudged_runs")


@pytest.fixture(scope="module")
def truth() -> Volume:
    return scene().voxelise(Grid.of_views(Views.evenly_spaced(8, SHAPE, PIXEL)))


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
    assert result.object.matter == Matter.one(*CELL)
    stages = list(dict.fromkeys(stage for stage, _ in told))
    assert stages[0] == "light and noise"
    assert "levels or continuous matter" in stages
    assert stages[-1] == "fit"
    assert told[-1] == ("fit", 1.0)
    assert all(0 <= fraction <= 1 for _, fraction in told)
    assert result.timing.keys() == {"decision", "start", "fit"}
    assert all(seconds > 0 for seconds in result.timing.values())


def test_held_out_frames_are_never_read(scan):
    """Poisoned with huge values, they change nothing at all, from the start on. A few steps on few pixels do."""
    coarse = scan.binned(2)
    volume = HolographicTV(retrieval=8, iterations=6, corrections=1, inner=4)
    few = replace(SMALL, approximate_steps=3, volume=volume, fit=replace(SMALL.fit, schedule=Schedule(steps=3)))
    frames = np.where(coarse.is_test[:, None, None], np.float32(1e30), coarse.frames)
    poisoned = replace(coarse, frames=frames)
    for settings, prior in ((few, KNOWN), (few, MaterialPrior.unknown()), (RANDOM, KNOWN)):
        a, b = (reconstruct(s, prior, settings).object for s in (coarse, poisoned))
        assert all(
            np.array_equal(p.numpy(), q.numpy())
            for p, q in zip(a.parameters().values(), b.parameters().values(), strict=True)
        )


def test_a_scan_without_training_frames_is_refused(scan, tmp_path):
    folder = RunFolder(tmp_path / "run")
    with pytest.raises(InputError, match="no training frame"):
        reconstruct(replace(scan, is_test=np.ones(8, dtype=bool)), KNOWN, SMALL, folder=folder)
    assert not folder.path.exists()


def test_values_of_other_types_are_refused_by_name(scan):
    for given, words in (
        ((scan.frames, KNOWN), "scan must be a Scan, as hs.read gives"),
        ((scan, "haemoglobin"), "prior must be a MaterialPrior.* but it is 'haemoglobin'"),
        ((scan, KNOWN, "gaussians"), "method must be options of a method.* but it is 'gaussians'"),
        ((scan, KNOWN, Voxels), "method must be options of a method"),
    ):
        with pytest.raises(InputError, match=words):
            reconstruct(*given)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda s: s.binned(6), "at least 11 columns"),
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
    result = reconstruct(scan, MaterialPrior.of_ratio(CELL.ratio), SMALL, matter="levels")
    found = evaluate(result, scan, truth)
    assert found.material.single_material
    assert found.material.ratio == pytest.approx(CELL.ratio)
    assert found.material.delta == pytest.approx(CELL.delta, rel=0.25, abs=0)
    assert found.volume.dice > 0.93
    assert "one for all" in found.lines()[-1]


@pytest.mark.parametrize("separate", [False, True])
def test_with_nothing_known_delta_and_beta_are_found(scan, truth, separate):
    """At the one ratio that the frames suggest, or fitted apart; nothing bounds the occupancy then."""
    result = reconstruct(scan, MaterialPrior.unknown(), replace(SMALL, separate=separate))
    found = evaluate(result, scan, truth)
    assert found.material.single_material != separate
    assert result.object.raw_amplitudes.shape[1] == 1 + separate
    assert found.material.delta == pytest.approx(CELL.delta, rel=0.35, abs=0)
    assert CELL.ratio / 2.5 < found.material.ratio < 2.5 * CELL.ratio
    assert found.volume.dice > 0.92
    assert f"δ {found.material.delta:.3e}" in found.lines()[-1]
    assert ("found apart" if separate else "one for all") in found.lines()[-1]


@pytest.mark.parametrize("prior", [KNOWN, MaterialPrior.unknown()], ids=lambda p: p.kind)
def test_the_occupancy_is_bounded_only_where_one_means_something(scan, prior):
    weights = Objective(tv_volume=0.05, overfull=10.0, two_levels=1.0)
    settings = replace(SMALL, fit=FitOptions(weights, Schedule(steps=2)))
    recorded: set[str] = set()
    result = reconstruct(scan, prior, settings, on_progress=lambda stage, part, record: recorded.update(record))
    assert result.object.matter.single
    assert "tv_volume" in recorded
    assert ({"overfull", "two_levels"} <= recorded) == (prior.kind == "known")


@pytest.mark.parametrize(("prior", "upper"), [(KNOWN, 1.0), (MaterialPrior.unknown(), 0.0)], ids=["known", "free"])
def test_so_is_the_occupancy_of_the_start(scan, monkeypatch, prior, upper):
    begun: list[HolographicTV] = []

    def begin(scan, material, options, on_progress, light, lines):
        begun.append(options)
        raise KeyboardInterrupt

    monkeypatch.setattr("holosplat.methods.start.holographic_tv", begin)
    with pytest.raises(KeyboardInterrupt):
        starting_cloud(Task(scan.train(), prior), SMALL)
    assert [options.upper for options in begun] == [upper]


def test_noisy_frames_get_fewer_and_larger_gaussians(scan):
    noisy = replace(scan, frames=scan.frames + np.random.default_rng(0).normal(0, 0.02, scan.frames.shape).astype("f4"))
    clouds = [starting_cloud(Task(noisy.train(), KNOWN), replace(SMALL, spacing_noise=rule)) for rule in (0.0, 2.3)]
    assert len(clouds[1]) < 0.5 * len(clouds[0])
    assert float(clouds[1].scales.median()) > 1.3 * float(clouds[0].scales.median())


@pytest.mark.parametrize(
    "prior", [KNOWN, MaterialPrior.of_ratio(2800.0), MaterialPrior.unknown()], ids=lambda p: p.kind
)
def test_a_random_start_runs_with_every_prior(scan, prior):
    settings = replace(RANDOM, fit=FitOptions(schedule=Schedule(steps=3)))
    result = reconstruct(scan, prior, settings)
    assert len(result.object) == 150
    assert result.object.matter.single == (prior.kind != "free")
    assert result.object.matter.delta > 0
    if prior.kind == "ratio":
        assert result.object.matter.channels[0].ratio == pytest.approx(2800)


def test_too_many_gaussians_become_larger_ones(scan):
    few = replace(SMALL, max_start=400, fit=FitOptions(schedule=Schedule(steps=1)))
    many = replace(few, max_start=10_000)
    counts = [len(reconstruct(scan, KNOWN, settings).object) for settings in (few, many)]
    assert counts[0] <= 400 < counts[1]


# --- evaluation ---------------------------------------------------------------------------------------------


def a_result() -> Reconstruction:
    """Two wide Gaussians far apart."""
    centres, log_scales = torch.tensor([[-12.0, 0, 0], [12.0, 0, 0]]), torch.full((2, 3), math.log(3))
    quaternions, raw = torch.tensor([[1.0, 0, 0, 0]]).repeat(2, 1), raw_of(torch.full((2, 1), 0.8))
    cloud = GaussianCloud((centres, log_scales, quaternions, raw), PIXEL, Matter.one(*CELL))
    return Reconstruction(cloud, "gaussians", 20.0, 2, {}, True)


def test_rendered_frames_are_measured_ones(scan):
    result = a_result()
    wanted = measure(result.object, scan.exposures, 2).detach().numpy()
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
    scores = evaluate(result, own, result.object.voxelise(grid))
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
    material = {"delta": CELL.delta, "ratio": CELL.ratio, "single_material": True, "delta_told": True}
    assert values["material"] == material
    assert values["train"]["mean"]["ssim"] == scores.train.mean["ssim"]
    said = [line.split(":")[0] for line in scores.lines() if not line.startswith(" ")]
    assert said == ["held-out frames", "training frames", "volume", "held-out frames", "material"]  # the 4th: verdict


def test_the_material_of_a_free_cloud_is_that_of_its_matter():
    """Most matter has the ratio 4, some the ratio 1; a faint halo of another ratio must not tip the balance."""
    amplitudes = torch.tensor([[0.8, 0.2], [0.8, 0.8], [0.05, 0.5], [1e-5, 1e-5], [1e-5, 1e-5]])
    sigmas = torch.tensor([3.43, 3.0, 7.1, 1.0, 1.0])  # 45, 30 and 25 % of the mass; the last two mark the corners
    centres = torch.tensor([[0.0, -25, 0], [0, 0, 0], [0, 35, 0], [-18, -40, -18], [18, 60, 18]])
    quaternions = torch.tensor([[1.0, 0, 0, 0]]).repeat(5, 1)
    cloud = GaussianCloud(
        (centres, sigmas.log()[:, None].repeat(1, 3), quaternions, raw_of(amplitudes)), PIXEL, Matter.free(*CELL)
    )
    found = material_found(cloud)
    assert not found.single_material
    assert found.ratio == pytest.approx(4 * CELL.ratio, rel=0.01)
    assert 0.1 * CELL.delta < found.delta < 0.8 * CELL.delta


def test_the_material_of_continuous_matter_is_what_its_volume_holds():
    """Its unit of δ says nothing of it, on both sides of the medium least of all."""
    values, unit = torch.zeros(1, 8, 9, 10), 1e-9
    values[0, 2:5, 2:5, 2:5], values[0, 6, 1:8, 1:8] = -500.0, 20.0
    found = VoxelGrid(values, Grid((8, 9, 10), (PIXEL,) * 3, (0.0, 0.0, 0.0)), Matter.one(unit, unit / 2000))
    assert material_found(found).delta == unit
    whole = material_found(found, "continuous")
    assert whole.single_material
    assert (whole.delta, whole.ratio) == pytest.approx((-500 * unit, 2000), rel=1e-5)


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
    assert reconstruct(scan, KNOWN, plain, seed=3, folder=folder, resume=True).object.backend == "reference"
    assert load_reconstruction(folder).object.backend == "reference"
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
