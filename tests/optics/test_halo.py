"""Halos in retrieved thickness: what has no curvature and comes from an edge goes, bodies stay."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from holosplat.optics.retrieval import without_halo

SHAPE = (71, 53)


def bodies() -> np.ndarray:
    """Two balls' thickness on a raster of odd sides [pixels]."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    balls = [(20.0, 15.0, 8.0), (66.0, 30.0, 9.0)]
    return sum(2 * np.sqrt(np.clip(r**2 - (y - cy) ** 2 - (x - cx) ** 2, 0, None)) for cy, cx, r in balls)


def halo() -> np.ndarray:
    """Harmonic: from a charge beyond the lower edge, which is none of the shapes that are fitted."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    return -4.0 * np.log(np.hypot(y - 84.0, x - 30.0) / 100.0)


@pytest.mark.parametrize("strength", [0.0, 1.0, 3.0])
def test_a_harmonic_halo_goes_and_bodies_stay(strength):
    thickness = torch.from_numpy(np.stack([bodies() + strength * halo(), bodies()]))
    left = without_halo(thickness) - torch.from_numpy(bodies())
    before = float((thickness[0] - torch.from_numpy(bodies())).std())
    assert float(left[0].std()) < 0.15 * before + 0.1
    assert float(left[1].abs().max()) < 0.5  # of 18 pixels at most
    assert float(left[1].std()) < 0.1
    assert left.dtype == thickness.dtype


def test_noise_is_left_as_it_is():
    noise = np.random.default_rng(3).normal(0, 0.3, SHAPE)
    thickness = torch.from_numpy((bodies() + halo() + noise)[None].astype(np.float32))
    found = without_halo(thickness, 0.3)
    left = (found[0].double() - torch.from_numpy(bodies()))[:55]  # below, a ball hides the halo that its edge has made
    assert found.dtype == torch.float32
    assert float(left.std()) == pytest.approx(0.3, rel=0.2)
    assert abs(float(left.median())) < 0.15
