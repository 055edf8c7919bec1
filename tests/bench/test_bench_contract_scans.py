"""The contract of methods, where less is known or views are unequal: a result, or the reason why there is none."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import holosplat as hs
from helpers.contract import MATERIAL, PITCH, QUICK, QUICKER, SCENE, SHAPE, run, usable
from holosplat_bench.suite.methods import METHODS, BenchMethod

pytestmark = pytest.mark.usefixtures("decided", "unjudged_runs")


@pytest.fixture(scope="module")
def unequal() -> hs.Scan:
    """Four training frames with poses about no common axis, and one held out."""
    views = hs.Views.from_rotations(Rotation.random(5, rng=3).as_matrix(), SHAPE, PITCH)
    return hs.simulate(SCENE, hs.Exposures.of(views, 20.0, 0.02), oversample=2, is_test=np.arange(5) == 4)


def result_or_reason(
    method: BenchMethod, scan: hs.Scan, prior: hs.MaterialPrior | None = None
) -> hs.volume.Object | str:
    """What the method makes of the scan, or why it cannot."""
    try:
        return run(method, scan, prior=prior)
    except hs.InputError as error:
        return str(error)


@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize("kind", ["ratio", "free"])
def test_a_method_does_without_the_material_or_says_why_not(name, scan, kind):
    prior = hs.MaterialPrior.of_ratio(MATERIAL.ratio) if kind == "ratio" else hs.MaterialPrior.unknown()
    found = result_or_reason(usable(name, QUICK), scan, prior)
    if isinstance(found, str):
        assert "material" in found
        return
    volume = found.voxelise(hs.Grid.of_views(scan.views))
    assert np.isfinite(volume.delta).all()
    if (name, kind) != ("onix", "free"):  # a network with δ and β free finds nothing in so few steps
        assert np.abs(volume.delta).max() > 0.1 * MATERIAL.delta


@pytest.mark.parametrize("name", METHODS)
def test_unequal_views_are_used_or_refused(name, unequal):
    found = result_or_reason(usable(name, QUICKER), unequal)
    if isinstance(found, str):
        assert "axis" in found
        return
    assert np.isfinite(found.voxelise(hs.Grid.of_views(unequal.views)).delta).all()
