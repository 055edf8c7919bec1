"""What every method of the benchmark must do: the contract that a new one turns green (docs/adding.md)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

import holosplat as hs
from helpers.contract import MATERIAL, PHOTOGRAPHS, PITCH, QUICK, SCENE, SHAPE, run, usable
from holosplat.model import Instrument, Model
from holosplat_bench.suite.methods import METHODS, BenchMethod
from holosplat_bench.suite.run import stored_bytes

pytestmark = pytest.mark.usefixtures("decided", "unjudged_runs")


@dataclass
class Made:
    """What a method made of the scan, and the progress that it told."""

    object: hs.volume.Object
    told: list[tuple[str, float]]


@pytest.fixture(scope="module")
def results() -> dict[str, Made]:
    """What each method makes of the scan; made once."""
    return {}


@pytest.fixture(params=list(METHODS))
def method(request) -> BenchMethod:
    """Each method, if what it needs is installed."""
    return usable(request.param, QUICK)


@pytest.fixture
def made(method, results, scan) -> Made:
    if method.name not in results:
        told: list[tuple[str, float]] = []
        known = hs.MaterialPrior.known(MATERIAL)
        found = method.run(scan.train(), known, 0, lambda stage, part: told.append((stage, part)))
        results[method.name] = Made(found, told)
    return results[method.name]


@pytest.fixture
def result(made) -> hs.volume.Object:
    """What the method makes of the scan."""
    return made.object


def test_every_method_is_described(method):
    assert METHODS[method.name].name == method.name
    assert method.family
    assert len(method.summary) > 20
    assert not method.summary.endswith(".")


def test_a_method_gives_an_object(result, scan):
    assert isinstance(result, hs.volume.Object)
    assert stored_bytes(result) > 0
    grid = hs.Grid.of_views(scan.views)
    volume = result.voxelise(grid)
    assert volume.delta.shape == grid.shape
    frames = Model(result, Instrument(scan.test().exposures)).frames()
    assert tuple(frames.shape) == (2, *SHAPE)
    assert bool(torch.isfinite(frames).all())


def test_a_method_finds_the_matter_where_it_is(result, scan, method):
    """Even in a few steps: not mirrored, not shifted, and with the sign of δ; without waves, in fog and with rims."""
    grid = hs.Grid.of_views(scan.views)
    found, true = (obj.voxelise(grid).delta.astype(np.float64) for obj in (result, SCENE))
    mirrored = [np.flip(true, axis) for axis in range(3)]
    correlation = [np.corrcoef(found.ravel(), other.ravel())[0, 1] for other in (true, *mirrored)]
    least, ahead = (0.2, 0.1) if method.name in PHOTOGRAPHS else (0.4, 0.2)
    assert correlation[0] > least
    assert correlation[0] > max(correlation[1:]) + ahead


def test_a_method_is_right_whatever_the_unit_of_length(method, result, scan):
    """Ten times larger, with δ and β a tenth and the same Fresnel number, the occupancy is the same."""
    views = replace(scan.views, pitch=10 * PITCH)
    exposures = replace(scan.exposures, views=views, distance=100 * scan.exposures.distance)
    prior = hs.MaterialPrior.known(hs.DeltaBeta(MATERIAL.delta / 10, MATERIAL.beta / 10))
    larger = run(method, replace(scan, exposures=exposures), prior=prior)
    one, other = (o.voxelise(hs.Grid.of_views(v)).delta for o, v in ((result, scan.views), (larger, views)))
    assert np.linalg.norm(10 * other - one) < 0.02 * np.linalg.norm(one)


def test_a_method_repeats_itself(method, result, scan):
    grid = hs.Grid.of_views(scan.views)
    again = run(method, scan)
    assert np.array_equal(again.voxelise(grid).delta, result.voxelise(grid).delta)


def test_a_method_reports_its_progress(made):
    assert made.told
    assert all(stage and 0 <= part <= 1 for stage, part in made.told)
