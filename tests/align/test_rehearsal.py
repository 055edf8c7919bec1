"""How wrong a search can be, by the same search of frames that its own result would give."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from helpers.misaligned_balls import MATERIAL, SHAPE, scan_of
from holosplat.align.derivatives import beside, motions
from holosplat.align.fixed_matter import Beside
from holosplat.align.marginal_likelihood import _larger
from holosplat.align.poses import PoseOptions, PosePrior, PoseSearch
from holosplat.align.views import Searched, rehearsed, with_random_phases
from holosplat.beamline.misalignment import Misalignment
from holosplat.geometry import Grid
from holosplat.matter import Matter
from holosplat.methods.surface_fit import oversampling
from holosplat.representations import SurfaceMesh, isosurface

FEW = PoseOptions(PosePrior(shift=1.0, angle=0.5, roll=0.5), rounds=1, retrieval=10, first=8, steps=3, edges=0)


def test_random_phases_keep_the_power_and_nothing_else():
    images = torch.randn(2, *SHAPE, generator=torch.Generator().manual_seed(3)).cumsum(2)
    found = with_random_phases(images, 0)
    power, wanted = (torch.fft.fft2(each).abs() for each in (found, images))
    torch.testing.assert_close(power, wanted, rtol=1e-3, atol=1e-3)
    rest = [each - each.mean((1, 2), keepdim=True) for each in (found, images)]
    alike = (rest[0] * rest[1]).sum() / rest[0].norm() / rest[1].norm()
    assert abs(float(alike)) < 0.3


@pytest.fixture(scope="module")
def done() -> Searched:
    scan, _ = scan_of(Misalignment(0.4, 0.2, 0.0, 3), 4, 9)
    search = PoseSearch(scan, MATERIAL, FEW, 1.0)
    level = search.levels()[-1]
    search.run(level, lambda part: None)
    return Searched(search, level.pixels, None)


def _moved(scan, options, by):
    """A search that ends elsewhere by `by` [V, 8], in pixels of `scan`."""
    search = PoseSearch(scan, MATERIAL, options, 1.0)
    search.numbers = by.clone()
    return Searched(search, 1, None)


def test_a_rehearsal_says_how_far_its_search_ends_from_what_was_put_in(done):
    """Beside a common motion; in detector pixels on frames that are binned, too; by frames like the measured ones."""
    views = done.search.scan.views
    draw = np.random.default_rng(1).normal(size=20) * np.tile([0.2, 0.2, 2e-3, 2e-3, 2e-3], 4)
    kept = beside(motions(views.in_units_of(views.pitch)))
    own = torch.from_numpy((kept @ kept.T @ draw).reshape(4, 5))
    for pixels in (1, 2):
        seen = []

        def again(scan, options, seen=seen, pixels=pixels):
            seen.append((scan, options))
            there = done.search.numbers.clone()
            there[:, :5] += own
            return _moved(scan, options, there / torch.tensor([pixels, pixels, 1, 1, 1, 1, 1, 1]))

        away = rehearsed(replace(done, pixels=pixels), again)
        np.testing.assert_allclose(away[:, :5], own.numpy(), atol=4e-3)
        scan, options = seen[0]
        assert options.uncertain.shift == pytest.approx(1.0 / pixels)
        measured = done.search.scan.binned(pixels).frames
        assert not np.allclose(scan.frames, measured, atol=1e-4)
        assert np.corrcoef(scan.frames.ravel(), measured.ravel())[0, 1] > 0.4
        assert scan.frames.std() == pytest.approx(measured.std(), rel=0.25)


def test_a_rehearsal_beside_surfaces_shows_the_surfaces(done):
    """With nothing left unexplained, its frames are those of the surfaces where they were found."""
    scan, search = done.search.scan, done.search
    mesh, unit = isosurface(search.volume.numpy(), Grid.of_views(scan.views)), scan.views.finest
    corners = torch.from_numpy(mesh.vertices / unit)
    surfaces = SurfaceMesh(corners, torch.from_numpy(mesh.faces), unit, Matter.one(*MATERIAL))
    images = Beside(surfaces, scan.exposures, oversampling(scan)).frames(search.numbers)
    exact = PoseSearch(replace(scan, frames=images.numpy()), MATERIAL, FEW, 1.0)
    exact.numbers = search.numbers
    seen = []

    def again(scan, options):
        seen.append(scan)
        return _moved(scan, options, search.numbers)

    away = rehearsed(Searched(exact, 1, surfaces), again)
    np.testing.assert_allclose(seen[0].frames, images.numpy(), atol=1e-6)
    assert np.abs(away).max() < 1e-9


def test_errors_are_made_as_large_as_they_were_and_no_smaller():
    away = np.array([[0.3, 0.4, 0.001], [0.0, 0.5, 0.001]])
    covariance = np.diag([0.01, 0.01, 0.04, 0.01, 0.01, 0.04])
    found = _larger(away, covariance, [[0, 1], [2]])
    root = np.sqrt((0.09 + 0.16 + 0.25) / 4) / 0.1
    np.testing.assert_allclose(found, [root, root, 1, root, root, 1])
