"""The scan that the tests of reconstruction share."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from helpers.once import Once, once
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
def begun_once(memory: Once) -> Iterator[Once]:
    """Runs on the same frames begin with what the first of them has found. To begin anew: `begun_once.made.clear()`."""
    with once(memory):
        yield memory
