"""Binned scans: where the pixels are, and what is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from helpers.holographic import CELL, PIXEL, SHAPE, cells, scan_of
from holosplat.checks import InputError
from holosplat.geometry import Views, rotation_y
from holosplat.matter import Matter
from holosplat.representations import GaussianCloud
from holosplat.representations.gaussians import raw_of
from holosplat.scan import Exposures, Scan


@pytest.mark.parametrize("factor", [2, 3])
@pytest.mark.parametrize("shape", [(36, 42), (37, 41), (38, 43), (41, 37)])
def test_binned_pixels_are_where_they_say(shape, factor):
    """A known Gaussian: its lines, binned, are its lines on the binned scan's own views, whatever their pixels."""
    centre, sigma = torch.tensor([[3.3, -2.2, 1.4]]), torch.full((1, 3), np.log(4.0))
    one = GaussianCloud(
        (centre, sigma, torch.tensor([[1.0, 0, 0, 0]]), raw_of(torch.tensor([[0.7]]))), PIXEL, Matter.one(1e-6, 1e-9)
    )
    shifts = PIXEL * np.array([[0, 0], [1.3, -0.6], [-0.4, 2.1]])
    sizes = PIXEL * np.array([1.0, 1.2, 1.1])
    views = Views.of_pixels(rotation_y([0, 40, 110]), shifts, shape, sizes)
    frames = one.project(views)[1].numpy() / 1e-6
    exposures = Exposures.of(views, 20.0, 0.1, 0.6)
    small = Scan(frames, exposures, np.array([False, True, False]), {"from": "here"}).binned(factor)
    assert small.frames.shape[1:] == small.views.shape == (shape[0] // factor, shape[1] // factor)
    assert small.views.pixel_sizes == pytest.approx(factor * sizes)
    wanted = one.project(small.views)[1].numpy() / 1e-6
    np.testing.assert_allclose(small.frames, wanted, rtol=0, atol=0.01 * wanted.max())
    np.testing.assert_allclose(small.exposures.psf_sigma_px, 0.6 / factor)
    np.testing.assert_array_equal(small.exposures.distance, exposures.distance)
    assert (small.is_test.tolist(), small.provenance) == ([False, True, False], {"from": "here"})


def test_binning_by_one_changes_nothing_and_by_too_much_is_refused():
    cell_scan = scan_of(cells(CELL), Views.evenly_spaced(8, SHAPE, PIXEL))
    assert cell_scan.binned(1) is cell_scan
    with pytest.raises(InputError, match="binned by 1 to 36, but not by 37"):
        cell_scan.binned(37)
    with pytest.raises(InputError, match="but not by 0"):
        cell_scan.binned(0)


def test_frames_views_and_exposures_of_other_kinds_are_refused():
    views = Views.evenly_spaced(8, SHAPE, PIXEL)
    with pytest.raises(InputError, match="frames must be intensities, but they are complex"):
        Scan(np.ones((8, *SHAPE), dtype=complex), Exposures.of(views, 20.0, 0.1), np.zeros(8, bool))
    with pytest.raises(InputError, match=r"energy_kev must have the shape \(8\), but it has the shape \(2\)"):
        replace(Exposures.of(views, 20.0, 0.1), energy_kev=np.array([20.0, 21.0]))
    for shape in (24, (24.5, 24), (24, 24, 24)):
        with pytest.raises(InputError, match="two positive counts"):
            Views.evenly_spaced(8, shape, PIXEL)  # pyright: ignore[reportArgumentType]
