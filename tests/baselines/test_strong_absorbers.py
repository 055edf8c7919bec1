"""Strong absorbers beside soft matter: rays are trusted by their photons, and neither material caps the other."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from helpers.contact import contact_scan, inside, transmission
from holosplat.baselines.primal_dual import PrimalDual
from holosplat.baselines.rays import FEWEST, photons_left
from holosplat.geometry import Grid
from holosplat.matter import DeltaBeta, MaterialPrior
from holosplat.methods import METHODS
from holosplat.workflows.reconstruct import reconstruct

SOFT, METAL, RATIO = 4e-8, 1.5e-6, 500.0
GELATINE = (0.0, 0.0, 0.0, 14.0, SOFT)
BEAD = (4.0, 1.0, -3.0, 3.0, METAL - SOFT)
"""What it adds to the gelatine; behind it and the gelatine 0.02 of the light is left."""


class Column:
    """Two voxels of which both rays see the sum."""

    array_shape: tuple[int, int, int] = (1, 1, 2)

    def project(self, array):
        return array.sum().expand(1, 1, 2).contiguous()

    def backproject(self, lines):
        return lines.sum().expand(1, 1, 2).contiguous()

    def volume_in(self, volume):
        return volume

    volume_out = lines_in = lines_out = volume_in


def test_rays_weigh_what_they_are_given():
    """Of two readings of one sum, weights 1 and 4, the weighted mean; without weights, the mean."""
    for weights, expected in ((None, 2.0), ([1.0, 4.0], 2.6)):
        solver = PrimalDual(Column(), torch.zeros(1, 1, 2), 0.0, None)
        if weights is not None:
            solver.weigh(torch.tensor(weights).reshape(1, 1, 2))
        solver.run(torch.tensor([1.0, 3.0]).reshape(1, 1, 2), 400)
        assert float(solver.lines()[0, 0, 0]) == pytest.approx(expected, rel=1e-3)


def test_weights_are_the_light_that_is_left():
    """`exp(-2kβT)`, not below a least share and not above one; none are needed where all rays pass half of it."""
    scan = contact_scan([GELATINE], (5, 7), count=2)
    mu = float(-np.log(transmission(SOFT, 1e-6)))
    lines = torch.tensor([0.0, -1.0, 1.0, 30.0]).reshape(1, 2, 2).repeat(2, 1, 1) * 1e-6 / mu
    found = photons_left(lines, scan.exposures, DeltaBeta(RATIO * SOFT, SOFT))
    assert found is not None
    assert found[0].flatten().tolist() == pytest.approx([1, 1, np.exp(-1), FEWEST], rel=1e-5)
    assert photons_left(0.02 * lines, scan.exposures, DeltaBeta(RATIO * SOFT, SOFT)) is None


@pytest.mark.usefixtures("unjudged_runs")
@pytest.mark.parametrize("name", ["holographic-tv", "voxels"])
def test_gelatine_beside_a_metal_bead(name):
    """Mean δ of the gelatine within 5 %, of the bead within 15 %, at 5000 photons."""
    scan = contact_scan([GELATINE, BEAD], (33, 40), photons=5000)
    assert scan.frames.min() < 0.03
    found = reconstruct(scan, MaterialPrior.of_ratio(RATIO), METHODS[name])
    volume = found.object.voxelise(Grid.of_views(scan.views))
    soft = inside(volume.grid, GELATINE, 0.85) & ~inside(volume.grid, BEAD, 1.7)
    bead = inside(volume.grid, BEAD, 0.7)
    assert volume.delta[soft].mean() == pytest.approx(RATIO * SOFT, rel=0.05)
    assert volume.delta[bead].mean() == pytest.approx(RATIO * METAL, rel=0.15)
    assert volume.delta[soft].std() < 0.15 * RATIO * SOFT
