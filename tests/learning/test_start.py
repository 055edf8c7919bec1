"""The guess of a scan: where it lies, on which pixels, and what it leaves unexplained."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor, nn

import holosplat as hs
from holosplat.geometry import Views
from holosplat.learning.network import FINE, THICKNESS, Taps
from holosplat.learning.start import GuessedMatter, guess_matter, spread
from holosplat.specimens import Ball

MATERIAL = hs.DeltaBeta(2e-7, 2e-10)
CENTRE = np.array([2.2e-6, -1.1e-6, -1.7e-6])
RADIUS = 2.5e-6


class Shadows(nn.Module):
    """Says that there is matter where every view shows some: what a network would learn first."""

    def forward(self, images: Tensor, taps: Taps) -> tuple[Tensor, Tensor]:
        thickness = nn.functional.avg_pool2d(images[:, 1:2], FINE) / THICKNESS
        least = taps.lift(thickness)[:, 0].amin(0).reshape(taps.grid)
        fine = least.repeat_interleave(2, 0).repeat_interleave(2, 1).repeat_interleave(2, 2)
        return 8 * (fine - 3), 8 * (fine - 3)


def scan_of(shape: tuple[int, int], pixel: float = 0.4e-6, shift: float = 0.0) -> hs.Scan:
    views = Views.from_angles([0.0, 60.0, 120.0], shape, pixel)
    views = Views(views.rotations, np.full((3, 2), shift * pixel), shape, pixel)
    ball = hs.MeshScene.of_one_material([Ball(CENTRE, 2 * RADIUS).mesh()], MATERIAL)
    return hs.simulate(ball, hs.Exposures.of(views, 12.0, 0.02), is_test=np.zeros(3, dtype=bool), oversample=4)


@pytest.mark.parametrize(("shape", "shift"), [((40, 48), 0.0), ((45, 41), 0.0), ((40, 48), 3.0)])
def test_matter_is_guessed_where_it_is(shape, shift):
    scan = scan_of(shape, shift=shift)

    found = guess_matter(scan, MATERIAL, Shadows(), lambda stage, fraction: None)  # type: ignore[arg-type]

    x, y, z = np.meshgrid(*found.grid.axes(), indexing="ij")
    share = found.values.numpy().transpose(2, 1, 0)
    middle = np.array([(share * axis).sum() / share.sum() for axis in (x, y, z)])
    assert np.abs(middle - CENTRE).max() < 0.4 * scan.views.finest
    assert share.sum() * scan.views.finest**3 == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.35)
    assert all(count % FINE == 0 and count >= n for count, n in zip(found.grid.shape[1:], shape))


def test_large_pixels_are_taken_where_they_explain_the_frames_clearly_better():
    scan, factors = scan_of((64, 66)), []

    class Larger(Shadows):
        """Knows the ball on large pixels alone."""

        def forward(self, images: Tensor, taps: Taps) -> tuple[Tensor, Tensor]:
            factors.append(images.shape[2])
            guess = super().forward(images, taps)
            return guess if images.shape[2] < 64 else (guess[0] - 100, guess[1] - 100)

    found = guess_matter(scan, MATERIAL, Larger(), lambda stage, fraction: None)  # type: ignore[arg-type]

    assert factors == [64, 32]
    assert found.values.shape[1] == 32
    assert found.grid.voxel_size[0] == pytest.approx(2 * scan.views.finest)
    assert found.left() < 0.5


def test_what_the_views_agree_on_has_no_spread():
    scan, network = scan_of((40, 48)), Shadows()
    found = guess_matter(scan, MATERIAL, network, lambda stage, fraction: None)  # type: ignore[arg-type]

    doubt = spread(found, network)  # type: ignore[arg-type]

    inside = found.values > 0.99
    assert float(doubt[inside].mean()) < 0.05 < float(doubt.max())  # two views alone see matter beside it


def two_views() -> hs.Scan:
    return scan_of((40, 48))[np.arange(2)]


def test_with_two_views_guesses_of_an_equivariant_network_have_no_spread():
    network = Shadows()
    found = guess_matter(two_views(), MATERIAL, network, lambda stage, fraction: None)  # type: ignore[arg-type]

    kept = GuessedMatter.of(found, MATERIAL, network)  # type: ignore[arg-type]

    assert kept.of_copies
    assert kept.spread.shape == kept.volume.grid.shape
    assert kept.spread.max() < 1e-5


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_with_two_views_it_shows_where_a_network_guesses_by_directions_of_its_own(axis):
    class Sided(Shadows):
        """Prefers one side of the field, whatever the frames say."""

        def forward(self, images: Tensor, taps: Taps) -> tuple[Tensor, Tensor]:
            guess = super().forward(images, taps)[1]
            side = torch.linspace(-2, 2, guess.shape[axis]).reshape([-1 if n == axis else 1 for n in range(3)])
            return guess + side, guess + side

    network = Sided()
    found = guess_matter(two_views(), MATERIAL, network, lambda stage, fraction: None)  # type: ignore[arg-type]

    assert float(spread(found, network).max()) > 0.1  # type: ignore[arg-type]


def test_an_empty_guess_leaves_everything():
    class Nothing(Shadows):
        """Sees nothing."""

        def forward(self, images: Tensor, taps: Taps) -> tuple[Tensor, Tensor]:
            empty = torch.full([2 * n for n in taps.grid], -50.0)
            return empty, empty

    found = guess_matter(scan_of((40, 48)), MATERIAL, Nothing(), lambda stage, fraction: None)  # type: ignore[arg-type]

    assert found.left() == pytest.approx(1.0, abs=1e-6)
