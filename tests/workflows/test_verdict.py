"""The verdict on runs: bad ones warn and name the cause, good ones do not."""

from __future__ import annotations

import json
import re
import shlex
from dataclasses import replace

import numpy as np
import pytest
import torch

from helpers.cli import holosplat, worked
from helpers.filled import filled
from helpers.fit_balls import MATERIAL, PIXEL
from helpers.runs import KNOWN, SMALL
from holosplat.align import find_axis
from holosplat.baselines import TOMOGRAPHIES
from holosplat.beamline.simulate import simulate
from holosplat.checks import InputError
from holosplat.fit.residuals import Prediction, residuals
from holosplat.geometry import Grid, Views
from holosplat.io.nxtomo import write_scan
from holosplat.matter import Matter
from holosplat.methods.method import Task
from holosplat.model import smooth_modes
from holosplat.optics.retrieval import paganin
from holosplat.representations import VoxelGrid
from holosplat.scan import Exposures, Scan
from holosplat.workflows.evaluate import held_out_verdict
from holosplat.workflows.next_step import STEPS, STIFF, next_step
from holosplat.workflows.reconstruct import load_reconstruction, reconstruct
from holosplat.workflows.run_folder import RunFolder
from holosplat.workflows.verdict import Verdict, judge, judge_run, verdict

SHAPE = (25, 32)


def soft(scale: float = 1.0, seed: int = 1) -> VoxelGrid:
    """Smooth bodies that end within the field."""
    grid = Grid.centred((32, 25, 32), PIXEL)
    z, y, x = np.meshgrid(*(axis / PIXEL for axis in grid.axes()), indexing="ij")
    values, random = np.zeros(grid.shape), np.random.default_rng(seed)
    for cx, cy, cz in random.uniform(-5, 5, (5, 3)):
        r2 = (x - cx) ** 2 + (y - cy) ** 2 + (z - cz) ** 2
        values += np.exp(-0.5 * r2 / random.uniform(2.0, 3.0) ** 2)
    return VoxelGrid(torch.from_numpy(scale * values).float()[None], grid, Matter.one(*MATERIAL))


def a_scan(obj: VoxelGrid, photons: float | None = None, count: int = 8, distance: float = 0.2) -> Scan:
    views = Views.evenly_spaced(count, SHAPE, PIXEL)
    return simulate(obj, Exposures.of(views, 20.0, distance, 0.3), photons_per_pixel=photons, seed=1, oversample=4)


def on(scan: Scan, obj: VoxelGrid) -> Verdict:
    return judge(Prediction(obj, scan.exposures, 2), scan)


def test_an_empty_object_is_said_to_be_empty():
    """Of frames that are noise it explains everything; of frames with matter it does not, and that is said instead."""
    scan = a_scan(soft(), 3000)
    noise = np.random.default_rng(3).normal(1.0, 0.02, scan.frames.shape).astype(np.float32)
    found = on(replace(scan, frames=noise), soft(0.0))
    assert not found.good
    assert found.words.startswith("No matter was found")
    assert "--bin" in found.reasons[0]
    assert "No matter" not in on(scan, soft(0.0)).words
    assert not on(scan, soft(0.0)).good


def test_frames_of_noise_show_no_matter_whatever_was_fitted_to_them():
    scan = a_scan(soft(), 3000)
    noise = np.random.default_rng(3).normal(1.0, 0.02, scan.frames.shape).astype(np.float32)
    found = on(replace(scan, frames=noise), soft(0.02, seed=2))
    assert not found.good
    assert found.words.startswith("No matter was found")
    assert found.reasons[0] == "What the volume holds was fitted to noise."
    assert "--bin" in found.reasons[1]


@pytest.mark.parametrize("photons", [None, 3000, 100_000])
def test_the_truth_is_good(photons):
    found = on(a_scan(soft(), photons), soft())
    assert found.good, found.words
    assert ("within their noise" in found.words) == (photons is not None)
    assert found.reasons == ()
    assert found.cause == ""
    assert len(found.lines("training frames")) == 1


def test_a_residual_above_the_noise_is_not_called_noise():
    """The model's own error is allowed, too, and more than a small noise."""
    found = on(a_scan(soft(), 400_000), soft(1.06))
    assert found.good
    assert "within noise and model error: the residual is 1.7 times the noise, 0.52 of both" in found.words


def test_half_of_the_mass_gone_is_said_though_noise_is_as_large_as_the_contrast():
    scan = a_scan(soft(0.5), 2000)
    contrast = float(np.sqrt(np.mean((a_scan(soft(0.5)).frames - 1) ** 2)))
    assert contrast < 2000**-0.5
    found = on(scan, soft(0.25))
    assert not found.good
    assert "more matter" in " ".join(found.reasons)
    assert found.tested["mass"]["value"] == pytest.approx(1.0, abs=0.25)
    assert found.tested["mass"]["significance"] > 5


def test_uneven_light_is_said():
    scan, modes = a_scan(soft(), 5000), smooth_modes(SHAPE, 2)
    light = torch.einsum("vk,khw->vhw", 0.007 * torch.randn(8, 9, generator=torch.Generator().manual_seed(1)), modes)
    found = on(replace(scan, frames=(scan.frames * light.exp().numpy()).astype(np.float32)), soft())
    assert not found.good
    assert "times the noise at periods" in found.words
    assert "uneven light in each frame" in found.reasons[0]
    assert found.cause == "light"
    command = "holosplat reconstruct SCAN --light smooth --out another_run"
    assert found.lines("training frames")[-1] == f"  Next: find the uneven light of each frame: {command}"


def test_a_wrong_distance_is_said_with_its_sign():
    scan = a_scan(soft(), 100_000)
    wrong = replace(scan, exposures=replace(scan.exposures, distance=0.8 * scan.exposures.distance))
    found = on(wrong, soft())
    assert not found.good
    assert "a distance" in found.reasons[0]
    assert "longer" in found.reasons[0]
    assert found.tested["distance"]["value"] == pytest.approx(0.25, abs=0.06)


def test_a_single_view_that_stands_out_is_named():
    scan = a_scan(soft(), 100_000)
    frames = scan.frames.copy()
    frames[3] = np.roll(frames[3], 3, axis=1)
    found = on(replace(scan, frames=frames), soft())
    assert not found.good
    assert any("Views that stand out, counted from 1: 4 (" in reason for reason in found.reasons)


def test_a_model_that_follows_the_noise_is_said():
    scan = a_scan(soft(), 3000)
    truth = a_scan(soft())
    half = replace(scan, frames=(0.5 * (scan.frames - truth.frames) + truth.frames).astype(np.float32))
    power = torch.full((8, SHAPE[0], SHAPE[1] // 2 + 1), 1 / 3000, dtype=torch.float64)
    said = verdict(residuals(Prediction(soft(), scan.exposures, 2), torch.from_numpy(half.frames), power))
    assert said.good
    assert "below the noise (0.5" in said.reasons[0]


def test_a_volume_has_no_levels_to_give_up(monkeypatch):
    """The next command would be the one that was given."""
    scan = a_scan(soft(), 100_000)
    stiff = replace(on(scan, soft(0.2)), cause=STIFF)
    monkeypatch.setattr("holosplat.workflows.verdict.verdict", lambda left: stiff)
    assert next_step(STIFF) is not None
    assert on(scan, soft(0.2)).cause == ""


def test_verdicts_survive_json_and_damage_is_refused():
    found = on(a_scan(soft(), 3000), soft(0.5))
    again = Verdict.from_dict(json.loads(json.dumps(found.as_dict(), allow_nan=False)))
    for name in ("good", "words", "reasons", "tested", "cause"):
        assert getattr(again, name) == getattr(found, name)
    assert found.cause in STEPS
    older = {name: value for name, value in found.as_dict().items() if name != "cause"}
    assert len(Verdict.from_dict(older).lines("frames")) == len(found.lines("frames")) - 1
    np.testing.assert_allclose(again.residual, found.residual, rtol=1e-3)
    np.testing.assert_array_equal(again.periods, found.periods)
    with pytest.raises(InputError, match="a verdict must be what reconstruct wrote"):
        Verdict.from_dict({"good": True})


def test_a_residual_far_above_the_contrast_is_a_factor_and_no_share():
    nothing = a_scan(soft(1e-4))
    found = on(nothing, soft())
    assert "times the contrast at periods" in found.words
    assert "% of the contrast" not in found.words


@pytest.mark.parametrize("cause", STEPS)
def test_the_next_command_is_one_that_there_is(cause):
    """Its options are those of `holosplat COMMAND --help-all`; names with blanks are kept whole by the caller."""
    step = next_step(cause, "'a scan.nxs'")
    assert step is not None
    program, act, *rest = shlex.split(step.command)
    assert (program, rest[0]) == ("holosplat", "a scan.nxs")
    help_text = holosplat(act, "--help-all").out
    assert all(option in help_text for option in rest if option.startswith("--"))
    assert next_step("blur") is None


# --- runs -----------------------------------------------------------------------------------------------------


def test_runs_carry_their_verdict(tmp_path, scan):
    """Of a short fit of cells: in Python, summary.json and the report's object; held-out frames have their own."""
    folder = RunFolder(tmp_path / "run")
    done = reconstruct(scan, KNOWN, SMALL, folder=folder)
    again = load_reconstruction(folder)
    assert done.verdict is not None
    assert again.verdict is not None
    assert again.verdict.words == done.verdict.words
    assert done.verdict.residual.shape[0] == len(scan.train())
    held_out = held_out_verdict(again, scan)
    assert held_out is not None
    assert held_out.residual.shape[0] == len(scan.test())
    assert held_out_verdict(again, scan.train()) is None


@pytest.mark.usefixtures("undrawn_reports")
def test_strict_runs_end_with_3_where_frames_are_not_explained(tmp_path):
    """Uneven light: with --strict 3; without, when the finished run is resumed, a warning and 0. Even light: 0.
    Of held-out frames alone: a warning, too."""
    method = ["--method", "holographic-tv", "--delta-beta", f"{MATERIAL[0] / MATERIAL[1]:.0f}"]
    method += ["--matter", "continuous", "--decide", "light=even", "noise=white"]
    even = a_scan(soft(3.0))
    modes = smooth_modes(SHAPE, 3)
    light = torch.einsum("vk,khw->vhw", 0.02 * torch.randn(8, 16, generator=torch.Generator().manual_seed(1)), modes)
    uneven = replace(even, frames=(even.frames * light.exp().numpy()).astype(np.float32))
    unseen = replace(even, frames=np.where(even.is_test[:, None, None], uneven.frames, even.frames))
    outcomes = {}
    for name, measured in (("even", even), ("uneven", uneven), ("unseen", unseen)):
        write_scan(tmp_path / f"{name}.nxs", measured)
        outcomes[name] = holosplat(
            "reconstruct", tmp_path / f"{name}.nxs", "--out", tmp_path / name, *method, "--strict"
        )
    assert outcomes["uneven"].code == 3
    assert "warning: the frames are not explained" in outcomes["uneven"].err
    assert "training frames: The frames are not explained" in outcomes["uneven"].out
    assert "warning: held-out frames are not explained" in worked(outcomes["unseen"]).err
    worked(outcomes["even"])
    assert "warning: the frames" not in outcomes["even"].err
    assert re.search(r"total δ \S+ m³ ± \S+ %", outcomes["even"].out)
    uneven_again = ("reconstruct", tmp_path / "uneven.nxs", "--out", tmp_path / "uneven", *method, "--resume")
    lax = worked(holosplat(*uneven_again))
    assert "warning: the frames are not explained" in lax.err
    page = (tmp_path / "uneven" / "report.html").read_text()
    assert "Are the frames explained?" in page
    assert "What is left of the training frames." in page
    assert "what the volume holds" in page
    judged = worked(holosplat("evaluate", tmp_path / "even"))
    assert "held-out frames: The frames are" in judged.out


@pytest.mark.parametrize(("shape", "distance"), [((25, 32), 0.0), ((1, 32), 0.2), ((3, 33), 0.2)])
def test_contact_frames_and_few_rows_have_a_verdict(shape, distance):
    views = Views.evenly_spaced(6, shape, PIXEL)
    scan = simulate(soft(3.0), Exposures.of(views, 20.0, distance, 0.3), photons_per_pixel=1e6, seed=1, oversample=4)
    found, wrong = (judge(Prediction(soft(mass), scan.exposures, 2), scan) for mass in (3.0, 4.5))
    assert found.good, found.words
    assert not wrong.good
    assert all(np.isfinite(value) for cause in wrong.tested.values() for value in cause.values())


def test_matter_that_goes_on_beyond_the_frames_is_named():
    """Rows of a scan that are cut in the middle of the bodies, and what a volume of these rows predicts."""
    whole, truth = a_scan(soft(), 100_000), soft()
    cut = whole.cropped(slice(8, 17), slice(0, 32))
    grid = Grid.of_views(cut.views)
    kept = VoxelGrid(truth.values[:, :, 8:17], grid, truth.matter)
    found = judge(Prediction(kept, cut.exposures, 2), cut)
    assert not found.good
    assert "matter goes on above or below" in found.reasons[0]
    narrow = whole.cropped(slice(0, 25), slice(10, 22))
    aside = VoxelGrid(truth.values[:, 10:22, :, 10:22], Grid.of_views(narrow.views), truth.matter)
    beside = judge(Prediction(aside, narrow.exposures, 2), narrow)
    assert not beside.good
    assert "matter goes on at the sides" in beside.reasons[0]
    wrong = on(whole, soft(0.6))  # as wrong, of whole bodies
    assert not wrong.good
    assert "goes on" not in wrong.reasons[0]


def of_a_volume(measured: Scan) -> Verdict:
    """The verdict on too little matter, which explains no frames: a filtered back-projection."""
    lines = paganin(torch.from_numpy(measured.frames), measured.exposures, *MATERIAL)
    grid = Grid.of_views(measured.views)
    values = 0.7 * TOMOGRAPHIES["fbp"](lines, measured.views, grid, None, lambda fraction: None)
    found = judge_run(VoxelGrid(values[None], grid, Matter.one(*MATERIAL)), None, Task(measured.as_static(), KNOWN), 1)
    assert not found.good
    return found


@pytest.mark.parametrize(("name", "shape", "photons"), [("crack", (31, 32), None), ("jet", (32, 32), 3000.0)])
def test_a_wrong_optimum_of_the_moments_is_no_cause(name, shape, photons):
    """The geometry is exact, but the moments of so few views of matter that leaves the field are sure of another."""
    scan = filled(name, shape, 8, photons)
    assert abs(find_axis(scan).offset.value) > 5
    assert "where the scan says: there the projections agree" not in " ".join(of_a_volume(scan).reasons)


def test_an_axis_elsewhere_is_the_cause_though_the_volume_has_followed_it():
    """Noise alone, and matter about the axis that the scan says, name none."""
    views = Views.evenly_spaced(12, SHAPE, PIXEL)
    scan = simulate(soft(), Exposures.of(views, 20.0, 0.2, 0.3), photons_per_pixel=20000, seed=1)
    away = views.shifts + np.array([3.2 * PIXEL, 0])
    for measured, is_elsewhere in ((scan.with_views(replace(views, shifts=away)), True), (scan, False)):
        found = of_a_volume(measured)
        assert (found.cause == "shift_x") == is_elsewhere
        assert any("the axis of rotation is 3.2 ± " in reason for reason in found.reasons) == is_elsewhere
        assert any("to the right of where the scan says" in reason for reason in found.reasons) == is_elsewhere
    assert "holosplat align SCAN --axis-only" in replace(found, cause="shift_x").lines("training frames")[-1]
