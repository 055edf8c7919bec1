"""What the line of a report says of the frames."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from holosplat.geometry import Views
from holosplat.report.run import _summary
from holosplat.scan import Exposures, Scan


@pytest.mark.parametrize(
    ("distance", "sources", "words"),
    [
        (0.02, None, "20 keV, 2 cm behind the sample; cells."),
        (0.02, [2e-4, 2e-4], "2 cm behind the sample, in cones of a source 0.2 mm before it; cells."),
        (0.0, [0.1, 0.1], "in contact, in cones of a source 100 mm before it; cells."),
    ],
)
def test_the_distance_and_the_source_are_said(distance, sources, words):
    views = replace(Views.evenly_spaced(2, (7, 9), 1e-6), sources=sources and np.array(sources))
    scan = Scan(np.ones((2, 7, 9)), Exposures.of(views, 20.0, distance), np.zeros(2, dtype=bool))
    done = SimpleNamespace(finished=True, object=SimpleNamespace(described="cells"))
    assert _summary(done, scan, None).endswith(words)  # type: ignore[arg-type]
