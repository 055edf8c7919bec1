"""A bounded body through the top and the bottom of the field: it goes on beyond the frames, and is not hollowed out."""

from __future__ import annotations

import numpy as np
import pytest

import holosplat as hs
from holosplat.baselines import HolographicTV, holographic_tv
from holosplat.geometry import Grid, Views
from holosplat.matter import DeltaBeta
from holosplat.scan import Exposures, Scan
from holosplat.specimens.continuous import ContinuousScene, Soft, ellipsoid

WATER = DeltaBeta(5.75e-7, 2.56e-10)
PIXEL, SHAPE, VIEWS = 1e-6, (31, 44), 8
HOW = HolographicTV(retrieval=30, iterations=100, refine=1)


def of(half_height: float) -> tuple[ContinuousScene, Scan]:
    body = ContinuousScene((ellipsoid(np.array([2e-6, 0.0, -1e-6]), (13e-6, half_height, 11e-6), Soft(0.0), WATER),))
    exposures = Exposures.of(Views.evenly_spaced(VIEWS, SHAPE, PIXEL), 20.0, 0.1)
    return body, hs.simulate(body, exposures, is_test=np.zeros(VIEWS, dtype=bool))


def test_a_body_through_the_field_keeps_its_outermost_rows():
    body, scan = of(120e-6)
    values, grid = holographic_tv(scan, WATER, HOW, lambda stage, share: None)
    more = (grid.shape[1] - SHAPE[0]) // 2
    assert more > 0
    assert grid.origin[1] == pytest.approx(Grid.of_views(scan.views).origin[1] - more * PIXEL)
    true = body.voxelise(grid).delta / WATER.delta
    for row in (more, more + SHAPE[0] - 1, more - 1):
        found = values[:, row].numpy()
        assert np.linalg.norm(found - true[:, row]) < 0.35 * np.linalg.norm(true[:, row])


def test_a_body_that_ends_in_the_field_has_no_rows_beyond_it():
    _, scan = of(9e-6)
    _, grid = holographic_tv(scan, WATER, HOW, lambda stage, share: None)
    assert grid.shape[1] == SHAPE[0]
