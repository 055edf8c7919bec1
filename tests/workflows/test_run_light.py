"""Held-out frames in uneven light: compared in the light that their own air shows, and drawn in the report."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from helpers.fit_balls import MATERIAL, PIXEL
from holosplat.baselines import HolographicTV
from holosplat.beamline.light import correlated_field
from holosplat.beamline.simulate import simulate
from holosplat.geometry import Grid, Views
from holosplat.inference import Decision
from holosplat.io.atomic import read_json
from holosplat.matter import DeltaBeta, MaterialPrior, Matter
from holosplat.methods import HolographicVoxels, illumination
from holosplat.methods.illumination import STAGE
from holosplat.methods.per_view import PerView
from holosplat.methods.trials import UNEVEN, name_of
from holosplat.optics.background import LightOptions
from holosplat.report.run import report_run
from holosplat.representations import VoxelGrid
from holosplat.scan import Exposures, Scan
from holosplat.workflows.evaluate import evaluate
from holosplat.workflows.reconstruct import Reconstruction, load_reconstruction, reconstruct
from holosplat.workflows.run_folder import RunFolder
from holosplat.workflows.run_illumination import EVEN, light_of, read_light_options

SHAPE = (45, 64)
MATTER = DeltaBeta(*MATERIAL)
SMOOTH = LightOptions("smooth")


def body() -> VoxelGrid:
    """A smooth body in the middle."""
    grid = Grid.centred((30, 30, 30), PIXEL)
    z, y, x = np.meshgrid(*(axis / PIXEL for axis in grid.axes()), indexing="ij")
    values = np.exp(-0.5 * ((x - 2) ** 2 + (y + 1) ** 2 + z**2) / 3.0**2)
    return VoxelGrid(torch.from_numpy(values).float()[None], grid, Matter.one(*MATERIAL))


def lit(count: int = 8, size: float = 0.03) -> tuple[Scan, np.ndarray]:
    """Views of the body with photon noise, each with smooth light of its own, and this light [V, H, W]."""
    views = Views.evenly_spaced(count, SHAPE, PIXEL)
    scan = simulate(body(), Exposures.of(views, 20.0, 0.1, 0.3), photons_per_pixel=1e5, seed=1, oversample=4)
    draw = np.random.default_rng(7)
    light = np.stack([1 + size * correlated_field(SHAPE, 30.0, draw) for _ in range(count)])
    return replace(scan, frames=(scan.frames * light).astype(np.float32)), light


def made(light: LightOptions) -> Reconstruction:
    """The truth as a result, of a run that assumed this light."""
    return Reconstruction(body(), "voxels", 20.0, 2, {}, True, light=light)


def test_held_out_frames_are_compared_in_the_light_of_their_own_air():
    scan, light = lit()
    even, smooth = (evaluate(made(kind), scan, None) for kind in (EVEN, SMOOTH))
    assert even.test is not None
    assert smooth.test is not None
    assert smooth.test.mean["ssim"] > even.test.mean["ssim"] + 0.1
    assert smooth.train is not None
    assert even.train is not None
    assert smooth.train.mean["frcm"] > 2 * even.train.mean["frcm"]
    assert smooth.verdict is not None
    assert even.verdict is not None
    assert smooth.verdict.good
    assert not even.verdict.good
    assert any(line.startswith("light: uneven by") for line in smooth.lines())
    assert smooth.as_dict()["light"].startswith("uneven by")
    assert even.as_dict()["light"] == "even"
    assert smooth.light is not None
    assert smooth.light.background is not None
    assert smooth.light.background.factor().numpy() == pytest.approx(light, abs=0.01)


def test_the_light_of_a_frame_does_not_come_from_the_prediction():
    """A reconstruction that lacks half of the matter is not helped by light that would make up for it."""
    scan, _ = lit()
    whole = body()
    half = whole.with_parameters({"values": 0.5 * whole.values})
    scores = evaluate(replace(made(SMOOTH), object=half), scan, None)
    assert scores.verdict is not None
    assert not scores.verdict.good
    assert scores.light is not None
    assert scores.light.background is not None
    again = light_of(scan, SMOOTH)
    assert again is not None
    assert again.background is not None
    assert torch.equal(scores.light.background.coefficients, again.background.coefficients)


def test_frames_without_air_are_taken_as_they_are():
    scan, _ = lit(4)
    crowded = replace(
        scan, frames=scan.frames[:, :20, :30], exposures=scan.cropped(slice(0, 20), slice(0, 30)).exposures
    )
    assert light_of(crowded, SMOOTH) is None
    assert light_of(scan, EVEN) is None


def test_what_a_folder_says_of_light():
    assert read_light_options({}, {}) == EVEN
    assert read_light_options({"light": {"kind": "auto", "air": []}}, {"light": "even"}) == EVEN
    boxes = {"light": {"kind": "auto", "air": [[0, 9, 0, 9]]}}
    assert read_light_options(boxes, {"light": "uneven by 2.1%"}) == LightOptions("smooth", ((0, 9, 0, 9),))


def decide_for(patch: pytest.MonkeyPatch, *taken: str) -> None:
    """These hypotheses are taken; what decides is tested in tests/methods/test_illumination.py."""
    patch.setattr(illumination, "decided", lambda *how: (taken, ()))
    patch.setattr(illumination, "confirmed", lambda *how: Decision(STAGE, name_of(taken), "told"))


def test_a_run_finds_light_keeps_it_and_draws_it(tmp_path, undrawn_reports, monkeypatch):
    decide_for(monkeypatch, UNEVEN, "fixed pattern")
    scan, _ = lit(6)
    scan = scan.cropped(slice(0, 45), slice(10, 58))
    pattern = 1 + 0.01 * np.random.default_rng(2).standard_normal(scan.views.shape)
    scan = replace(scan, frames=(scan.frames * pattern).astype(np.float32))
    folder, quick = RunFolder(tmp_path / "run"), PerView("paganin", "fbp")
    run = reconstruct(scan, MaterialPrior.known(MATTER), quick, folder=folder, matter="levels")
    assert run.light == SMOOTH
    assert load_reconstruction(folder).light == SMOOTH
    assert read_json(folder.summary)["light"].startswith("uneven")
    page = report_run(folder, run, scan, evaluate(run, scan, None), None).read_text()
    assert "light is uneven by" in page
    assert " and the same " in page
    assert "Uneven light." in page


@pytest.mark.usefixtures("unjudged_runs")
def test_light_in_common_is_kept_with_the_run_and_evaluated_in(tmp_path, monkeypatch):
    decide_for(monkeypatch, "fixed pattern")
    scan, _ = lit(16, 0.0)
    pattern = 1 + 0.01 * np.random.default_rng(2).standard_normal(SHAPE)
    scan = replace(scan, frames=(scan.frames * pattern).astype(np.float32), is_test=np.arange(16) % 4 == 3)
    folder = RunFolder(tmp_path / "run")
    run = reconstruct(scan, MaterialPrior.known(MATTER), PerView("paganin", "fbp"), folder=folder, matter="levels")
    assert run.still is not None
    assert np.std(run.still / pattern) < 0.3 * np.std(pattern)
    again = load_reconstruction(folder)
    assert again.still is not None
    np.testing.assert_array_equal(again.still, run.still)
    assert again.light == EVEN
    assert read_json(folder.summary)["light"].startswith("the same ")
    known, unknown = (evaluate(each, scan, None) for each in (again, replace(again, still=None)))
    assert known.test is not None
    assert unknown.test is not None
    assert known.test.mean["ssim"] > unknown.test.mean["ssim"] + 0.1
    assert any("in all frames; predictions are compared in it" in line for line in known.lines())
    other = evaluate(again, scan.cropped(slice(0, 45), slice(0, 50)), None)
    assert other.light is None  # of another raster


@pytest.mark.usefixtures("unjudged_runs")
def test_light_that_a_method_solves_for_is_kept_with_the_run():
    scan, _ = lit(6, 0.0)
    rows = np.cos(np.pi * (np.arange(SHAPE[0]) + 0.5) / SHAPE[0])
    scan = replace(scan, frames=(scan.frames * np.exp(0.03 * rows)[:, None]).astype(np.float32))
    method = HolographicVoxels(volume=HolographicTV(still_light=1, retrieval=20, iterations=40, upper=0.0))
    run = reconstruct(scan, MaterialPrior.known(MATTER), method, light=LightOptions("even"), matter="levels")
    assert run.still is not None
    assert run.still == pytest.approx(np.broadcast_to(np.exp(0.03 * rows)[:, None], SHAPE), abs=0.01)
