"""What a prediction leaves of frames: powers by band, and the causes that score tests name."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from helpers.fit_balls import MATERIAL, PIXEL
from holosplat.checks import InputError
from holosplat.fit.misfit_diagnosis import cause_scores, excess, likely_causes
from holosplat.fit.residuals import Prediction, Residuals, Rings, residuals
from holosplat.geometry import Views
from holosplat.matter import Matter
from holosplat.model import Alignment, LightField, smooth_modes
from holosplat.representations import GaussianCloud
from holosplat.representations.gaussians import raw_of
from holosplat.scan import Exposures

SHAPE, VIEWS, SIGMA = (25, 32), 6, 0.004


def cloud(mass: float = 1.0) -> GaussianCloud:
    """Blobs of two to three pixels."""
    r = torch.Generator().manual_seed(3)
    centres = torch.rand(8, 3, generator=r) * torch.tensor([16.0, 12.0, 16.0]) - torch.tensor([8.0, 6.0, 8.0])
    round_ones = torch.tensor([1.0, 0, 0, 0]).repeat(8, 1)
    raw = raw_of(mass * (0.5 + torch.rand(8, 1, generator=r)))
    return GaussianCloud((centres, torch.full((8, 3), 0.8), round_ones, raw), PIXEL, Matter.one(*MATERIAL))


def said(obj: GaussianCloud | None = None, **parts) -> Prediction:
    views = Views.evenly_spaced(VIEWS, SHAPE, PIXEL)
    return Prediction(obj or cloud(), Exposures.of(views, 20.0, 0.2, 0.6), 2, **parts)


def frames_of(prediction: Prediction, sigma: float = SIGMA) -> torch.Tensor:
    with torch.no_grad():
        frames = torch.cat([prediction.view(i).frames() for i in range(VIEWS)]).double()
    return frames + sigma * torch.randn(frames.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)


def left(measured: torch.Tensor, prediction: Prediction | None = None) -> Residuals:
    power = torch.full((VIEWS, SHAPE[0], SHAPE[1] // 2 + 1), SIGMA**2, dtype=torch.float64)
    return residuals(prediction or said(), measured, power)


@pytest.mark.parametrize("shape", [(25, 32), (24, 31), (16, 16), (1, 40), (3, 41), (3, 200)])
def test_bands_hold_every_coefficient_once_and_keep_the_power(shape):
    rings = Rings.of(shape, PIXEL)
    frames = torch.randn(2, *shape, dtype=torch.float64)
    power = torch.fft.rfft2(frames, norm="ortho").abs().square()
    assert rings.counts.sum() == shape[0] * shape[1]
    assert rings.counts.all()
    total = (rings.mean(power) * rings.counts).sum(axis=1)
    np.testing.assert_allclose(total, frames.square().sum(dim=(1, 2)), rtol=1e-12)
    assert rings.periods(0)[1] == np.inf
    assert all(rings.periods(b)[0] == rings.periods(b + 1)[1] for b in range(len(rings) - 1))


def test_a_wave_lies_in_the_band_of_its_period():
    rings, column = Rings.of((24, 48), PIXEL), torch.arange(48, dtype=torch.float64)
    wave = torch.cos(2 * torch.pi * column * 6 / 48).expand(1, 24, 48)  # eight pixels
    found = rings.mean(torch.fft.rfft2(wave, norm="ortho").abs().square())[0]
    shortest, longest = rings.periods(int(found.argmax()))
    assert shortest <= 8 * PIXEL * 1.0001
    assert longest > 8 * PIXEL
    assert np.count_nonzero(found > 1e-12) == 1


def test_the_true_object_leaves_the_noise_and_has_no_cause():
    found = left(frames_of(said()))
    ratio = (found.residual.mean(axis=0) * found.rings.counts).sum() / (SIGMA**2 * np.prod(SHAPE))
    assert ratio == pytest.approx(1.0, abs=0.08)
    assert max(cause.significance for name, cause in cause_scores(found).items() if name in ("mass", "distance")) < 4
    assert excess(found) < 0.02 * VIEWS * np.prod(SHAPE)


TRUE = {
    "mass": said(cloud(1.08)),
    "distance": said(alignment=Alignment(stretches=torch.full((VIEWS,), 0.1, dtype=torch.float64))),
    "blur": said(alignment=Alignment(blurs=torch.full((VIEWS,), 0.2, dtype=torch.float64))),
    "shift_x": said(alignment=Alignment(shifts=torch.tensor([[0.4, 0.0]], dtype=torch.float64).repeat(VIEWS, 1))),
    "shift_y": said(alignment=Alignment(shifts=torch.tensor([[0.0, -0.4]], dtype=torch.float64).repeat(VIEWS, 1))),
}
VALUES = {"mass": 0.08, "distance": 0.1, "blur": 0.8**2 - 0.6**2, "shift_x": 0.4, "shift_y": -0.4}


@pytest.mark.parametrize("name", TRUE)
def test_the_cause_is_named_with_its_size(name):
    """The frames are those of another experiment; the object is the right one, so that the score test is exact."""
    named = likely_causes(left(frames_of(TRUE[name])))
    assert named[0].name == name
    assert float(named[0].value[0]) == pytest.approx(VALUES[name], rel=0.2)
    assert named[0].significance > 8
    assert named[0].share > 0.6


def test_views_shifted_by_themselves_are_named_with_their_shifts():
    shifts = torch.zeros(VIEWS, 2, dtype=torch.float64)
    shifts[1], shifts[4] = torch.tensor([0.5, -0.3]), torch.tensor([-0.5, 0.3])
    named = likely_causes(left(frames_of(said(alignment=Alignment(shifts=shifts)))))
    assert named[0].name == "shifts"
    np.testing.assert_allclose(named[0].value, shifts, atol=0.1)


def test_uneven_light_is_named_with_its_size():
    modes = smooth_modes(SHAPE, 2)
    coefficients = 0.005 * torch.randn(VIEWS, len(modes), generator=torch.Generator().manual_seed(2))
    named = likely_causes(left(frames_of(said(light=LightField(coefficients, modes)))))
    assert named[0].name == "light"
    assert named[0].share > 0.8
    np.testing.assert_allclose(named[0].value, coefficients, atol=0.002)


def test_what_was_fitted_of_light_and_alignment_is_no_cause():
    light = LightField(torch.full((VIEWS, 9), 0.004), smooth_modes(SHAPE, 2))
    known = said(alignment=TRUE["distance"].alignment, light=light)
    found = left(frames_of(known), known)
    assert excess(found) < 0.02 * VIEWS * np.prod(SHAPE)
    assert excess(left(frames_of(known))) > VIEWS * np.prod(SHAPE)


def test_without_noise_a_share_of_the_contrast_is_allowed():
    frames, none = frames_of(said(), 0.0), torch.zeros(VIEWS, SHAPE[0], SHAPE[1] // 2 + 1)
    near, far = (residuals(replace(said(), object=cloud(mass)), frames, none) for mass in (1.02, 1.15))
    over = [float((r.residual.mean(axis=0) / r.allowed.mean(axis=0)).max()) ** 0.5 for r in (near, far)]
    assert over[0] < 0.6
    assert over[1] > 1.5


def test_frames_of_another_shape_are_refused():
    with pytest.raises(InputError, match="must have the shape"):
        left(torch.ones(VIEWS, 25, 31))
