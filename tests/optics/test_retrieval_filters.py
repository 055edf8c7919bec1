"""Filters of phase retrieval: closed forms and gradients."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from helpers.retrieval import (
    BETA,
    CELL_BETA,
    CELL_DELTA,
    DELTA,
    DOUBLE,
    ENERGY,
    LAMBDA,
    PITCH,
    K,
    _squared_distance,
    at,
    exposures,
    gaussian,
    pixels,
    taken,
)
from holosplat.geometry import Views
from holosplat.model import Instrument
from holosplat.optics.noise import wavelet_noise
from holosplat.optics.retrieval import (
    Linear,
    Prior,
    contrast_transfer,
    invert_contrast,
    paganin,
    retrieve_thickness,
)
from holosplat.optics.retrieval.spectra import (
    Raster,
    detector_transfer,
    response,
    spectra,
    squared_frequency,
)
from holosplat.scan import Exposures

# --- filters, in closed form --------------------------------------------------------------------------------


def transported(where: Exposures, height: float, sigma_px: float, beta: float) -> Tensor:
    """Frame [1, H, W] of Paganin's forward model, `I = (1 - z δ/μ ∇²) exp(-μT)`, of a Gaussian thickness."""
    x, y = pixels(where.views)
    t, mu, s2 = gaussian(where.views, height, sigma_px), 2 * K * beta, (sigma_px * PITCH) ** 2
    r2 = _squared_distance(x, y, (3.3, -5.2))
    laplacian = torch.exp(-mu * t) * (mu**2 * t**2 * r2 / s2**2 - mu * t * (r2 / s2 - 2) / s2)
    return (torch.exp(-mu * t) - float(where.distance[0]) * DELTA / mu * laplacian)[None]


@pytest.mark.parametrize("shape", [(95, 131), (131, 95)])
def test_paganin_inverts_the_transport_of_intensity(shape):
    """However strong the phase is (here 24 rad): eq. 12 is exact there."""
    beta, where = DELTA / 50, exposures(shape, at(8.0))
    truth = gaussian(where.views, 320e-6, 9.0)
    assert K * DELTA * float(truth.max()) > 20
    frames = transported(where, 320e-6, 9.0, beta)
    for options in (Linear(noise=0.0), Linear(noise=1e-9, model_error=1e-7)):
        found = paganin(frames, where, DELTA, beta, options=options)[0]
        assert float((found - truth).abs().max()) < 1e-4 * 320e-6  # what the continued edges leave


def weak_frame(where: Exposures, height: float, sigma_px: float, ratio: float) -> Tensor:
    """Frame [1, H, W] of a weak Gaussian phase, to first order: Fresnel leaves it a Gaussian, of complex width."""
    x, y = pixels(where.views)
    s2 = (sigma_px * PITCH) ** 2
    q = s2 + 1j * LAMBDA * float(where.distance[0]) / (2 * math.pi)
    field = height * s2 / q * torch.exp(-0.5 * _squared_distance(x, y, (3.3, -5.2)) / q)
    return (1 - 2 * ((ratio + 1j) * field).real)[None]


@pytest.mark.parametrize("ratio", [0.02, -0.02])
def test_contrast_transfer_inverts_weak_holograms(ratio):
    """Far from contact (λz = 20 squared pitches), where the transport of intensity is no answer."""
    where = exposures((95, 131), at(20.0))
    frames, truth = weak_frame(where, 1e-3, 4.0, ratio), gaussian(where.views, 1e-3 / (K * DELTA), 4.0)
    options = Linear(noise=0.0, model_error=1e-6)
    found = contrast_transfer(frames, where, DELTA, ratio * DELTA, options=options)[0]
    high = truth - torch.nn.functional.avg_pool2d(truth[None, None], 41, 1, 20, count_include_pad=False)[0, 0]
    missed = found - truth
    missed = missed - torch.nn.functional.avg_pool2d(missed[None, None], 41, 1, 20, count_include_pad=False)[0, 0]
    assert float(missed.abs().max()) < 1e-3 * float(high.abs().max())


def test_the_filters_have_gradients():
    where = exposures((9, 11))
    frames = (
        1 + 0.01 * torch.randn(1, 9, 11, dtype=DOUBLE, generator=torch.Generator().manual_seed(1))
    ).requires_grad_()
    for retrieve in (paganin, contrast_transfer):
        found = retrieve(frames, where, DELTA, BETA, options=Linear(noise=0.0))
        assert torch.isfinite(torch.autograd.grad(found.sum(), frames)[0]).all()


def test_noise_is_measured():
    for sigma in (0.003, 0.05):
        generator = torch.Generator().manual_seed(4)
        frames = 1 + sigma * torch.randn(3, 91, 77, dtype=DOUBLE, generator=generator)
        assert wavelet_noise(frames).numpy() == pytest.approx(np.full(3, sigma), rel=0.05)


def test_expected_power_explains_the_frames():
    """Of all frequencies together, `H² S` is the variance beyond the noise."""
    generator, where = torch.Generator().manual_seed(5), exposures((48, 64))
    frames = 1 + 0.1 * torch.randn(1, 48, 64, dtype=DOUBLE, generator=generator)
    raster = Raster((48, 64), PITCH)
    h = response(where, 0.01, raster)
    known = spectra(frames, where, h, raster, 0.06, 0.0, Prior())
    seen = squared_frequency(raster) <= (0.5 / PITCH) ** 2
    explained = (h.square() * known.power)[:, seen]
    contrast = (frames - 1).square().mean()
    assert float(explained.mean()) == pytest.approx(float(contrast) - 0.06**2, rel=1e-9)


def test_the_pixel_counts_on_finer_rasters_only():
    where = exposures((12, 14), psf=0.7)
    own, fine = (detector_transfer(where, Raster((12 * s, 14 * s), PITCH / s)) for s in (1, 2))
    f = 3 / (12 * PITCH)
    gauss = math.exp(-2 * (math.pi * 0.7 * PITCH * f) ** 2)
    assert float(own[0, 3, 0]) == pytest.approx(gauss)
    assert float(fine[0, 3, 0]) == pytest.approx(gauss * np.sinc(f * PITCH))


# --- the filters that other modules use ---------------------------------------------------------------------


@pytest.mark.parametrize("shape", [(61, 87), (95, 71)])
def test_the_plain_filter_recovers_a_smooth_object(shape):
    """Paganin et al. (2002): right to 1 % for one material where χ is small, at two distances."""
    beta, where = DELTA / 100, exposures(shape, np.array([at(2.0), at(4.0)]), count=2)
    truth, frames = taken(lambda v: gaussian(v, 10e-6, 8.0), where, DELTA, beta)
    found = retrieve_thickness(frames, PITCH, where.distance, ENERGY, DELTA, beta)
    assert float((found - truth).abs().max()) < 0.01 * 10e-6
    # and not because the contact image would do: propagation changes it by far more
    contact = -torch.log(frames) / (2 * K * beta)
    assert float((contact - truth).abs().max()) > 0.5 * 10e-6
    assert torch.equal(paganin(frames, where, DELTA, beta, options=Linear(noise=0.0)), found)


def ripples(shape: tuple[int, int], lambda_z: float, beta: float) -> tuple[Tensor, Tensor]:
    """Thickness [1, H, W] of frequencies around (0.11, 0.08) per pixel only, and weak frames of it."""
    where = exposures(shape, at(lambda_z))
    instrument = Instrument(where, 1, DOUBLE)

    def thickness(views: Views) -> Tensor:
        x, y = pixels(views)
        wave = torch.cos(2 * math.pi * (0.11 * x + 0.08 * y) / PITCH)
        return (gaussian(views, 1e-6, 7.0, (0.0, 0.0)) * wave)[None]

    full = thickness(instrument.views)
    return thickness(where.views), instrument.image(full * beta, full * CELL_DELTA)


@pytest.mark.parametrize("shape", [(61, 87), (95, 71)])
@pytest.mark.parametrize("beta", [CELL_BETA, -0.01 * CELL_DELTA])
def test_contrast_of_negative_beta_is_inverted(shape, beta):
    """Where phase contrast answers, within 1 %; for the larger β its share of the answer is 3 %."""
    lambda_z = 10.0
    truth, frames = ripples(shape, lambda_z, beta)
    options = (PITCH, np.array([at(lambda_z)]), ENERGY, CELL_DELTA, beta)
    found = invert_contrast(frames - 1, *options)
    assert float((found - truth).abs().max()) < 0.01 * float(truth.abs().max())
    assert torch.equal(retrieve_thickness(frames, *options), found)  # Paganin's filter has a pole there


def test_inversion_is_bounded_where_the_response_changes_sign():
    """For β < 0 the response is zero at tan χ = -β/δ: no frequency is multiplied by more than 1/(2·2k|β|)."""
    beta, lambda_z = -0.01 * CELL_DELTA, 10.0
    crossing = math.sqrt(math.atan(0.01) / (math.pi * lambda_z))  # cycles per pixel
    x, _ = pixels(exposures((61, 337)).views)
    contrast = torch.cos(2 * math.pi * crossing * x / PITCH).expand(1, 61, -1)
    found = invert_contrast(contrast, PITCH, np.array([at(lambda_z)]), ENERGY, CELL_DELTA, beta)
    assert float(found.norm()) <= float(contrast.norm()) / (4 * K * abs(beta))
