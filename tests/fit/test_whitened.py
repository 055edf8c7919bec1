"""The misfit of frames in units of their noise: its value, its slopes, and what it takes for noise."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from helpers.blobs import MATERIAL, PIXEL, SHAPE, blob_lines, blob_scan
from helpers.two_balls import scan
from holosplat.fit.whitened import WhitenedFrames, model_error
from holosplat.geometry import Views
from holosplat.model import LightField, smooth_modes
from holosplat.optics.noise import NoiseModel
from holosplat.scan import Exposures, Scan


def lines(share: float = 0.9) -> torch.Tensor:
    """What a projector gives of the blobs [pixels], a little off, so that there is a misfit."""
    return share * blob_lines(Views.evenly_spaced(4, SHAPE, PIXEL), boxes=(1, 2)).float() / PIXEL


def whitened(measured: Scan, light: LightField | None = None) -> WhitenedFrames:
    noise = NoiseModel.white_only(torch.full((len(measured),), 0.02, dtype=torch.float64), SHAPE)
    return WhitenedFrames(measured, MATERIAL, noise, light)


@pytest.mark.parametrize("distance", [0.12, 0.01], ids=["coarse waves", "fine waves"])
@pytest.mark.parametrize("lit", [False, True])
def test_the_gradient_is_that_of_the_value(distance, lit):
    light = LightField(0.05 * torch.ones(4, 4), smooth_modes(SHAPE, 1)) if lit else None
    misfit = whitened(blob_scan(distance, count=4), light)
    assert (misfit.instrument.oversample > 1) == (distance < 0.1)
    at, step = lines(), 0.02
    toward = misfit(at).gradient / misfit(at).gradient.abs().max()
    slope = (misfit(at + step * toward).value - misfit(at - step * toward).value) / (2 * step)
    np.testing.assert_allclose(float((misfit(at).gradient * toward).sum()), slope, rtol=5e-3)


def test_noise_alone_has_a_chi_square_of_one_a_pixel():
    """Of the true amplitudes: what the optics of voxels leaves is far below this noise."""
    measured = blob_scan(photons=2000, count=4)
    misfit = WhitenedFrames(measured, MATERIAL, NoiseModel.white_only(torch.full((4,), 2000**-0.5), SHAPE))
    assert 2 * misfit(lines(1.0)).value / misfit.count == pytest.approx(1.0, abs=0.08)


def test_the_curvature_is_the_second_derivative_for_thin_matter():
    exposures = Exposures.of(Views.evenly_spaced(1, SHAPE, PIXEL), 15.0, 0.12)
    flat = Scan(np.ones((1, *SHAPE), dtype=np.float32), exposures, np.zeros(1, dtype=bool))
    misfit = WhitenedFrames(flat, MATERIAL, NoiseModel.white_only(torch.full((1,), 0.02), SHAPE))
    row, column = (np.arange(n) for n in SHAPE)
    inside = np.exp(-((row[:, None] - 12) ** 2 + (column - 15) ** 2) / 40)
    ripple = torch.from_numpy(inside * np.cos(2 * np.pi * 0.15 * column)).float()[None]
    small = 0.01 * ripple
    expected = 0.5 * torch.fft.irfft2(torch.fft.rfft2(small) * misfit.curvature(), s=SHAPE).mul(small).sum()
    # the optics is told of sharper lines than these, by 1/sinc(0.15) across the axis
    assert misfit(small).value == pytest.approx(float(expected) / np.sinc(0.15) ** 2, rel=0.05)


def test_the_normal_equations_are_those_of_the_misfit():
    misfit, at = whitened(blob_scan(count=4)), lines()
    changes = [at, torch.roll(at, 3, dims=2)]
    matrix, right = misfit.normal_equations(at, changes)
    slopes = [-float((misfit(at).gradient * change).sum()) for change in changes]
    np.testing.assert_allclose(right.numpy(), slopes, rtol=0.05)
    assert torch.linalg.eigvalsh(matrix).min() > 0
    share = torch.linalg.solve(matrix, right)
    better = at + sum(float(s) * change for s, change in zip(share, changes))
    assert misfit(better).value < 0.1 * misfit(at).value


def test_frames_without_noise_have_the_error_of_their_voxels():
    """It grows with the frequency, and there is none in frames without contrast."""
    frames = torch.from_numpy(scan().frames)
    none = torch.zeros(6, 25, 15, dtype=torch.float64)
    error = model_error(frames, none)
    power = torch.fft.rfft2(frames.double() - 1, norm="ortho").abs().square().mean(dim=0)
    coarse, fine = (slice(1, 3), slice(1, 3)), (slice(8, 12), slice(8, 12))
    assert float(error[coarse].sum() / power[coarse].sum()) < 1e-3
    assert 0.02 < float(error[fine].sum() / power[fine].sum()) < 0.5
    assert float(model_error(torch.ones_like(frames), none).abs().max()) == 0
