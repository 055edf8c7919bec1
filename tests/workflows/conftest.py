"""The scan that the tests of reconstruction share."""

from __future__ import annotations

import pytest

from helpers.runs import PIXEL, SHAPE, scene
from holosplat.beamline.simulate import simulate
from holosplat.geometry import Views
from holosplat.scan import Exposures, Scan


@pytest.fixture(scope="module")
def scan() -> Scan:
    """Eight noise-free views of six red cells, two of them held out."""
    scan = simulate(scene(), Exposures.of(Views.evenly_spaced(8, SHAPE, PIXEL), 20.0, 0.1))
    assert scan.is_test.sum() == 2
    return scan


@pytest.fixture(scope="module", autouse=True)
def _once(plain_light: None) -> None:
    """All runs share what they begin with, in light as they are told."""
