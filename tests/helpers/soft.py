"""Two soft cells of graded index and their views, by which smooth volumes and what they tell are judged."""

from __future__ import annotations

import numpy as np

from holosplat.beamline.simulate import simulate
from holosplat.geometry import Views
from holosplat.matter import DeltaBeta
from holosplat.scan import Exposures, Scan
from holosplat.specimens.continuous import ContinuousScene
from holosplat.specimens.soft_matter import soft_cells

PIXEL, SHAPE, DISTANCE = 1.3e-6, (31, 35), 0.085
MATERIAL = DeltaBeta(6e-7, 4e-10)


def cells() -> ContinuousScene:
    """Two soft cells that fit the detector in every view."""
    return soft_cells(2, (15e-6, 18e-6), (40e-6, 38e-6, 40e-6), MATERIAL, seed=3, edge=3e-6)


def two_cells(count: int = 8) -> Scan:
    """`count` views at 20 keV, without noise."""
    exposures = Exposures.of(Views.evenly_spaced(count, SHAPE, PIXEL), 20.0, DISTANCE)
    return simulate(cells(), exposures, is_test=np.zeros(count, dtype=bool))
