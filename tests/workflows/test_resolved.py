"""config.json says what options have become: weights after noise and views, widths in the frames' units."""

from __future__ import annotations

import json
from dataclasses import replace
from math import sqrt

import pytest

from holosplat.baselines import HolographicTV
from holosplat.beamline.simulate import simulate
from holosplat.fit.problem import Schedule
from holosplat.geometry import Views
from holosplat.matter import DeltaBeta, MaterialPrior
from holosplat.methods import Gaussians
from holosplat.scan import Exposures, Scan
from holosplat.specimens import MeshScene, random_cells
from holosplat.workflows.reconstruct import reconstruct
from holosplat.workflows.run_folder import RunFolder

CELL = DeltaBeta(1e-6, 1e-9)
QUICK = Gaussians(
    approximate_steps=2,
    volume=HolographicTV(retrieval=5, iterations=10, corrections=0),
    fit=replace(Gaussians().fit, schedule=Schedule(steps=1)),
)


def scan(photons: float | None) -> Scan:
    exposures = Exposures.of(Views.evenly_spaced(4, (24, 29), 1e-6), 20.0, 0.05)
    cells = random_cells(2, (20e-6, 16e-6, 20e-6), 1, 10e-6)
    return simulate(MeshScene.of_one_material(cells, CELL), exposures, photons_per_pixel=photons)


@pytest.mark.usefixtures("unjudged_runs")
@pytest.mark.parametrize("photons", [None, 300.0])
def test_the_weights_that_noise_and_views_make_are_kept(tmp_path, photons):
    folder = RunFolder(tmp_path / "run")
    reconstruct(scan(photons), MaterialPrior.known(CELL), QUICK, folder=folder, matter="levels")
    config = json.loads(folder.config.read_text())
    found, asked = config["resolved"]["fit"], QUICK.fit.objective
    scale = 29 / 100 * sqrt(8 / 3)  # depth of the field; the fourth view is held out
    assert found["tv_volume"] == pytest.approx(scale * asked.tv_volume)
    assert found["overfull"] == pytest.approx(scale * asked.overfull)
    gained = found["two_levels"] / (scale * asked.two_levels)
    assert (gained > 1.05) == (photons is not None)
    assert (found["coarse"] > 0.1) == (photons is not None)
    assert found["oversample"] >= 1
    assert 0 < found["noise_width"] < 1


@pytest.mark.usefixtures("unjudged_runs")
def test_a_prior_that_knows_no_level_leaves_its_terms_out(tmp_path):
    folder = RunFolder(tmp_path / "run")
    reconstruct(scan(None), MaterialPrior.unknown(), QUICK, matter="levels", folder=folder)
    config = json.loads(folder.config.read_text())
    assert not {"overfull", "two_levels"} & set(config["resolved"]["fit"])
    assert config["method"]["fit"]["objective"]["overfull"] == QUICK.fit.objective.overfull
