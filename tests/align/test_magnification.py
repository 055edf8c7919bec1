"""Magnification of single views: what frames say of it, and beams whose pixels differ."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from helpers.misaligned_balls import BALLS, MATERIAL, PIXEL, SHAPE, scan_of
from holosplat.align import AlignedViews, PoseOptions, PosePrior, align_views
from holosplat.align.derivatives import NUMBERS, blurred, in_pixels, predicted
from holosplat.align.poses import PoseSearch
from holosplat.beamline.misalignment import Misalignment
from holosplat.checks import InputError
from holosplat.geometry import Grid, Views, rotation_tilted
from holosplat.matter import MaterialPrior
from holosplat.scan import Exposures, Scan

STEPS = torch.tensor([0.1, 0.1, 0.01, 0.01, 0.01, 0.02, 0.01, 0.01]).double()
"""Of central differences, in the order of `NUMBERS`."""


def soft_balls(grid: Grid) -> torch.Tensor:
    """Gaussians [Z, Y, X] as wide as the balls; the grid is in pixels."""
    x, y, z = grid.axes()
    squares = (((z[:, None, None] - c) ** 2 + (y[:, None] - b) ** 2 + (x - a) ** 2) / r**2 for a, b, c, r in BALLS[:4])
    return torch.from_numpy(sum(np.exp(-square) for square in squares)).float()


def test_frames_change_as_their_derivatives_say():
    """By all numbers, in views of two pixel sizes, distances and energies, but for a pixel's blur and the ripple of
    voxels."""
    sizes = PIXEL * np.array([1.0, 1.3])
    shifts = PIXEL * np.array([[1.2, -0.7], [-0.4, 0.9]])
    views = Views.of_pixels(rotation_tilted([20, 75], [5, -8]), shifts, SHAPE, sizes)
    exposures = Exposures(views, np.array([20.0, 17.0]), np.array([0.1, 0.15]), np.full(2, 0.3), np.zeros(2), 20.0)
    uncertain = PosePrior(distance=0.02, magnification=0.01)
    scan = Scan(np.ones((2, *SHAPE), dtype=np.float32), exposures, np.zeros(2, dtype=bool))
    search = PoseSearch(scan, MATERIAL, PoseOptions(uncertain), None)
    grid = Grid.of_views(in_pixels(views))
    volume = soft_balls(grid)

    def frames(numbers: torch.Tensor) -> torch.Tensor:
        search.numbers = numbers
        lit = numbers[:, -1].exp()[:, None, None]
        return lit * predicted(volume, grid, search.exposures(exposures), MATERIAL, 1).frames

    said = predicted(volume, grid, exposures, MATERIAL, 1, magnified=True).derivatives
    for k, name in enumerate(NUMBERS):
        step = torch.zeros(2, len(NUMBERS)).double()
        step[:, k] = STEPS[k]
        found, own = blurred((frames(step) - frames(-step)) / (2 * STEPS[k]), 1.0), blurred(said[:, k], 1.0)
        for v in range(2):
            assert float((found[v] - own[v]).norm()) < 0.2 * float(found[v].norm()), name
            assert 0.87 < float((found[v] * own[v]).sum() / found[v].square().sum()) < 1.05, name


@pytest.fixture(scope="module")
def magnified() -> tuple[Scan, Exposures, AlignedViews]:
    scan, true = scan_of(Misalignment(0.5, 0.3, 0.0, 2, magnification=0.01), 6)
    options = PoseOptions(PosePrior(magnification=0.01), rounds=3, retrieval=10, first=20, edges=0)
    return scan, true, align_views(scan, MaterialPrior.known(MATERIAL), options)


def away(found: Exposures, true: Exposures, of: np.ndarray) -> float:
    """Rms error of the magnification beside its mean."""
    return float(np.log(true.views.pixel_sizes / found.views.pixel_sizes)[of].std())


def test_the_magnification_of_every_view_is_found(magnified):
    scan, true, found = magnified
    assert away(scan.exposures, true, ~scan.is_test) > 0.006
    assert away(found.exposures, true, ~scan.is_test) < 0.004
    assert 0.0005 < np.median(found.errors[:, 6]) < 0.006
    assert "magnification" in found.lines()[0]


def test_the_mean_magnification_is_as_planned(magnified):
    """Of a larger object nearer to the source frames know nothing."""
    scan, _, found = magnified
    sizes = found.exposures.views.pixel_sizes[~scan.is_test]
    assert np.log(sizes / PIXEL).mean() == pytest.approx(0, abs=1e-9)


def test_magnification_is_as_planned_unless_it_is_uncertain():
    scan, _ = scan_of(Misalignment(0.5, 0.0, 0.0, 2, magnification=0.01), 4)
    options = PoseOptions(PosePrior(1.0, 0.0, 0.0), rounds=1, retrieval=5, first=5, edges=0)
    found = align_views(scan, MaterialPrior.known(MATERIAL), options)
    np.testing.assert_array_equal(found.exposures.views.pixel_sizes, scan.views.pixel_sizes)
    assert not found.changes[:, 6].any()
    with pytest.raises(InputError, match=r"uncertain magnification must be 0\.1 at most, but it is 0\.5"):
        replace(options.uncertain, magnification=0.5)
