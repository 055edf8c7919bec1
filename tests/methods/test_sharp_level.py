"""The level of sharp matter in noise, where its ratio δ/β is known alone."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

from holosplat.baselines.material import estimate_delta, level_of
from holosplat.baselines.tomography import plateau
from holosplat.beamline.simulate import simulate
from holosplat.checks import NoMatterError
from holosplat.geometry import Grid, Views
from holosplat.matter import DeltaBeta, MaterialPrior, Matter
from holosplat.methods import SmoothVolume, Task
from holosplat.methods import volume as sharp_level
from holosplat.methods.method import first_of_task
from holosplat.methods.volume import material_of_levels
from holosplat.representations import VoxelGrid
from holosplat.scan import Exposures, Scan
from holosplat.specimens import MeshScene
from holosplat_bench.specimens.phantoms import place_capsules

PIXEL = 1e-6
WATER = DeltaBeta(6e-7, 4e-10)


@pytest.fixture(scope="module")
def noisy() -> Scan:
    """Four capsules in noise of 0.4 of their contrast."""
    box = (29 * PIXEL, 27 * PIXEL, 29 * PIXEL)
    meshes = [c.outer(name=f"{i}") for i, c in enumerate(place_capsules((8 * PIXEL, 11 * PIXEL), 4, box, PIXEL, 3))]
    exposures = Exposures.of(Views.evenly_spaced(8, (31, 33), PIXEL), 20.0, 0.03)
    scan = simulate(MeshScene.of_one_material(meshes, WATER), exposures, is_test=np.zeros(8, dtype=bool))
    sigma = 0.4 * float(np.sqrt(np.square(scan.frames - 1).mean()))
    counts = np.random.default_rng(1).poisson(scan.frames / sigma**2)
    return replace(scan, frames=(counts * sigma**2).astype(np.float32))


def test_noise_takes_nothing_off_the_level(noisy):
    """As it does by tomography."""
    said = set()
    task = Task(noisy, MaterialPrior.of_ratio(WATER.ratio), on_progress=lambda stage, part: said.add(stage))
    found = material_of_levels(task)
    assert found.delta == pytest.approx(WATER.delta, rel=0.1)
    assert found.ratio == pytest.approx(WATER.ratio)
    assert estimate_delta(noisy, WATER.ratio, task.on_progress) < 0.8 * WATER.delta
    assert "level of the matter" in said


def test_a_level_is_never_below_that_of_tomography(noisy, monkeypatch):
    """Where voxels are larger than thin shells, the likeliest volume dilutes them."""
    task = Task(noisy, MaterialPrior.of_ratio(WATER.ratio))
    tomography = estimate_delta(noisy, WATER.ratio, task.on_progress)
    monkeypatch.setattr(sharp_level, "SmoothVolume", partial(SmoothVolume, coarser=(), iterations=1))
    for level, delta in ((0.1, tomography), (3.0, 3 * tomography)):
        monkeypatch.setattr(sharp_level, "level_of", lambda values, level=level: level)
        assert material_of_levels(task).delta == pytest.approx(delta)


def test_a_known_level_is_taken(noisy):
    known = DeltaBeta(5e-7, 4e-10)
    assert material_of_levels(Task(noisy, MaterialPrior.known(known))) == known


def test_the_level_is_that_of_the_denser_class():
    """However much haze there is; within the class it is the mass-weighted median."""
    bodies, haze = torch.tensor([0.8] * 10 + [1.0] * 30 + [1.1] * 5), torch.full((2000,), 0.05)
    volume = torch.cat([haze, bodies]).reshape(5, 409, 1)
    assert level_of(volume) == 1
    assert plateau(volume) == pytest.approx(0.05)
    assert level_of(volume[:, torch.randperm(409)]) == 1
    with pytest.raises(NoMatterError):
        level_of(torch.zeros(3, 4, 5))


def test_a_level_takes_as_many_views_as_take_no_longer(noisy):
    """A volume of few rows has few voxels, and 181 views of it take as long as twelve of many rows."""
    few = sharp_level.VIEWS * sharp_level.EDGE**3 // (2 * 320**2)
    for shape, views, wanted in (((2, 320), 181, few), ((2, 320), few, few), ((200, 200), 20, 12), ((31, 33), 8, 8)):
        exposures = Exposures.of(Views.evenly_spaced(views, shape, PIXEL), 20.0, 0.0)
        scan = Scan.of(np.ones((views, *shape), dtype=np.float32), exposures, np.zeros(views, dtype=bool), {})
        task = sharp_level.in_few_views(Task(scan, MaterialPrior.of_ratio(1.0)))
        assert len(task.scan) == wanted
        assert task.scan.views.rotations[[0, -1]].tolist() == scan.views.rotations[[0, -1]].tolist()


def test_a_run_finds_its_level_once_and_takes_that_of_a_volume_that_is_there(noisy):
    said = list[str]()
    prior = MaterialPrior.of_ratio(WATER.ratio)
    plain = Task(noisy, prior, on_progress=lambda stage, part: said.append(stage))
    task = replace(plain, first=first_of_task(plain))
    found = material_of_levels(task)
    assert "level of the matter" in said
    said.clear()
    assert material_of_levels(task) == found
    assert said == []
    grid = Grid.of_views(noisy.views)
    known = VoxelGrid(torch.full((1, *grid.shape), 3.0), grid, Matter.one(*WATER))
    assert material_of_levels(replace(plain, likeliest=known)).delta == pytest.approx(3 * WATER.delta)
    assert "level of the matter" not in said
