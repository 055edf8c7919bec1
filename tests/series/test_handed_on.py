"""What a time hands on to the next one beside its state."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch

import holosplat as hs
from helpers.series import SETTINGS, known, moving
from holosplat.geometry import Grid, Views
from holosplat.inference import Decision
from holosplat.materials import parse_material
from holosplat.matter import MaterialPrior, Matter
from holosplat.methods.contrast import BELOW, BOTH, SPHERICAL, STAGE
from holosplat.optics.background import LightOptions
from holosplat.representations import SurfaceMesh, VoxelGrid
from holosplat.scan import Exposures
from holosplat.series import one_time
from holosplat.series.folder import read_row
from holosplat.series.one_time import Before, Shot, reconstruct_time
from holosplat.series.plan import Settings
from holosplat.specimens import Substances
from holosplat.specimens.phantoms import Ball
from holosplat.workflows.reconstruct import load_reconstruction
from holosplat.workflows.run_folder import RunFolder
from holosplat_bench.specimens.gas_waves import ExpandingShock


class Asked(Exception):
    """Raised in place of a reconstruction."""


@pytest.mark.parametrize("sides", [BOTH, SPHERICAL])
def test_a_warm_time_is_told_the_sides_that_the_one_before_decided(sides, done, tmp_path, monkeypatch):
    before = RunFolder(tmp_path / "before")
    shutil.copytree(done.run(0, 0), before.path)
    summary = {**before.read_summary(), "decisions": [Decision(STAGE, sides, "views set aside").as_dict()]}
    before.summary.write_text(json.dumps(summary))
    row, priors = read_row(done.row(0, 0)), []

    def asked(scan, prior, *_, **__):
        priors.append(prior)
        raise Asked

    monkeypatch.setattr(one_time, "reconstruct", asked)
    shot = Shot(moving(2).at_instant(1), known(20.0), {}, row)
    with pytest.raises(Asked):
        reconstruct_time(shot, SETTINGS, RunFolder(tmp_path / "next"), Before(before, row))
    assert priors[0].two_sided
    assert priors[0].spherical == (sides == SPHERICAL)


def test_a_warm_sphere_is_not_thrown_away_for_cold_surfaces(done, tmp_path, monkeypatch):
    """In one view, whose short run makes one kind alone: training frames are surely for the sphere. It is told what is
    known of the sphere, not what was before the sides were decided."""
    water = parse_material("water").delta_beta(20.0)
    scene = ExpandingShock(29e-6).drawn(Substances(water, medium=water), 2).scene.at(0.5)
    exposures = Exposures.of(Views.from_angles([0.0], (33, 37), 1e-6), 20.0, 0.1)
    scan = hs.simulate(scene, exposures, photons_per_pixel=3000.0, seed=2, is_test=np.zeros(1, dtype=bool))
    grid = Grid.of_views(exposures.views)
    matter = Matter.one(water.delta, water.beta)
    values = torch.from_numpy((scene.voxelise(grid).delta / water.delta).astype(np.float32))[None]
    sphere = VoxelGrid(values, grid, matter)
    ball = Ball(np.zeros(3), 6e-6).mesh()
    cold = SurfaceMesh(torch.tensor(ball.vertices / 1e-6), torch.tensor(ball.faces), 1e-6, matter)
    known_of = MaterialPrior.of_ratio(water.ratio).on_both_sides().about_a_point()
    asked = []
    decide = one_time.decide_kind

    def told(task, *how):
        asked.append((task.prior, decide(task, *how)))
        return asked[-1][1]

    monkeypatch.setattr(one_time, "decide_kind", told)
    below = Decision(STAGE, BELOW, "data fission").as_dict()
    by = RunFolder(tmp_path)
    by.config.write_text(json.dumps({"decided": {"light": [], "decisions": [below]}}))
    run = load_reconstruction(RunFolder(done.run(0, 0)))
    found = {"warm": replace(run, object=sphere, oversample=1), "cold": replace(run, object=cold, oversample=1)}
    shot = Shot(scan, MaterialPrior.of_ratio(water.ratio), {}, read_row(done.row(0, 0)))
    settings = Settings(light=LightOptions("even", still="none", noise="white"))
    decision = one_time._better(shot, known_of, settings, found, by)
    assert decision.choice == "warm"
    assert asked == [(known_of, None)]
