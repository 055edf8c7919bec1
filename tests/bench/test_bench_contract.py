"""What every method of the benchmark must do: the contract that a new one turns green (docs/adding.md)."""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

import holosplat as hs
from holosplat.bench.method import Method
from holosplat.bench.methods import METHODS, methods
from holosplat.model import Instrument, Model
from holosplat.specimens.red_cells import icosphere

MATERIAL = hs.DeltaBeta(2e-7, 2e-10)
PITCH = 1e-6
SHAPE = (24, 31)
QUICK = methods(effort=0.05) | {"neural-field": methods(effort=0.25)["neural-field"]}
"""The same methods with a small part of their steps: the contract is about form, not about quality."""
QUICKER = methods(effort=0.05)
"""With a still smaller part, where finite numbers are all that is asked for."""
NEEDS = {"paganin-svmbir": "svmbir"}
"""Methods that need a package of the extra `bench`."""


def ball(centre: tuple[float, float, float], radius: float) -> hs.TriangleMesh:
    """A ball [pixels]."""
    vertices, faces = icosphere(3)
    return hs.TriangleMesh(PITCH * (radius * vertices + np.array(centre)), faces)


SCENE = hs.MeshScene.of_one_material([ball((-6, 2, 3), 5), ball((7, -3, -4), 4)], MATERIAL)


@pytest.fixture(scope="module")
def scan() -> hs.Scan:
    """Six training frames of two balls, and two held out."""
    exposures = hs.Exposures.of(hs.Views.evenly_spaced(8, SHAPE, PITCH), 20.0, 0.02)
    return hs.simulate(SCENE, exposures, oversample=2)


@dataclass
class Made:
    """What a method made of the scan, and the progress that it told."""

    object: hs.Object
    told: list[tuple[str, float]]


@pytest.fixture(scope="module")
def results() -> dict[str, Made]:
    """What each method makes of the scan; made once."""
    return {}


def run(method: Method, scan: hs.Scan, seed: int = 0, prior: hs.MaterialPrior | None = None) -> hs.Object:
    known = hs.MaterialPrior.known(MATERIAL)
    return method.run(scan.train(), prior or known, seed, lambda stage, fraction: None)


def result_or_reason(method: Method, scan: hs.Scan, prior: hs.MaterialPrior | None = None) -> hs.Object | str:
    """What the method makes of the scan, or why it cannot."""
    try:
        return run(method, scan, prior=prior)
    except hs.InputError as error:
        return str(error)


@pytest.fixture(params=list(METHODS))
def method(request) -> Method:
    """Each method, if what it needs is installed."""
    package = NEEDS.get(request.param)
    if package and importlib.util.find_spec(package) is None:
        pytest.skip(f"{package} is not installed")
    return QUICK[request.param]


@pytest.fixture
def made(method, results, scan) -> Made:
    if method.name not in results:
        told: list[tuple[str, float]] = []
        known = hs.MaterialPrior.known(MATERIAL)
        found = method.run(scan.train(), known, 0, lambda stage, part: told.append((stage, part)))
        results[method.name] = Made(found, told)
    return results[method.name]


@pytest.fixture
def result(made) -> hs.Object:
    """What the method makes of the scan."""
    return made.object


def test_every_method_is_described(method):
    assert METHODS[method.name].name == method.name
    assert method.family
    assert len(method.summary) > 20
    assert not method.summary.endswith(".")


def test_a_method_gives_an_object(result, scan):
    assert isinstance(result, hs.Object)
    assert result.stored_bytes > 0
    grid = hs.Grid.of_views(scan.views)
    volume = result.voxelise(grid)
    assert volume.delta.shape == grid.shape
    frames = Model(result, Instrument(scan.test().exposures)).frames()
    assert tuple(frames.shape) == (2, *SHAPE)
    assert bool(torch.isfinite(frames).all())


def test_a_method_finds_the_matter_where_it_is(result, scan):
    """Even in a few steps: not mirrored, not shifted, and with the sign of δ."""
    grid = hs.Grid.of_views(scan.views)
    found, true = (obj.voxelise(grid).delta.astype(np.float64) for obj in (result, SCENE))
    mirrored = [np.flip(true, axis) for axis in range(3)]
    correlation = [np.corrcoef(found.ravel(), other.ravel())[0, 1] for other in (true, *mirrored)]
    assert correlation[0] > 0.4
    assert correlation[0] > max(correlation[1:]) + 0.2


def test_a_method_is_right_whatever_the_unit_of_length(method, result, scan):
    """Ten times larger, with δ and β a tenth and the same Fresnel number, the occupancy is the same."""
    views = replace(scan.views, pixel_size=10 * PITCH)
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


@pytest.mark.parametrize("kind", ["ratio", "free"])
def test_a_method_does_without_the_material_or_says_why_not(method, scan, kind):
    prior = hs.MaterialPrior.of_ratio(MATERIAL.ratio) if kind == "ratio" else hs.MaterialPrior.unknown()
    found = result_or_reason(method, scan, prior)
    if isinstance(found, str):
        assert "material" in found
        return
    volume = found.voxelise(hs.Grid.of_views(scan.views))
    assert np.abs(volume.delta).max() > 0.1 * MATERIAL.delta


def test_unequal_views_are_used_or_refused(method):
    """Poses about no common axis: a result, or the reason why there is none."""
    from scipy.spatial.transform import Rotation

    views = hs.Views.from_rotations(Rotation.random(5, rng=3).as_matrix(), SHAPE, PITCH)
    scan = hs.simulate(SCENE, hs.Exposures.of(views, 20.0, 0.02), oversample=2, is_test=np.arange(5) == 4)
    found = result_or_reason(QUICKER[method.name], scan)
    if isinstance(found, str):
        assert "axis" in found
        return
    assert np.isfinite(found.voxelise(hs.Grid.of_views(scan.views)).delta).all()
