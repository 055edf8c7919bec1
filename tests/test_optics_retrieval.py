"""Phase retrieval of single views: closed forms, gradients, and a contract that every method keeps.

Frames of bodies come from the float64 reference optics on a raster finer than any method's, of thicknesses in closed
form. Distances are given by `at(lambda_z)`, the distance [m] at which λz has that many squared pitches.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from holosplat.checks import InputError
from holosplat.geometry import Views
from holosplat.model.instrument import Instrument
from holosplat.optics.noise import wavelet_noise
from holosplat.optics.retrieval import (
    ADMM,
    RETRIEVALS,
    Linear,
    Prior,
    Projections,
    Tikhonov,
    admm,
    bounded_estimate,
    contrast_transfer,
    gerchberg_saxton,
    hybrid_input_output,
    invert_contrast,
    iterative,
    model,
    paganin,
    retrieve_thickness,
    tikhonov,
)
from holosplat.optics.retrieval.admm import _laplacian, gradient, gradient_adjoint
from holosplat.optics.retrieval.iterative import through_detector
from holosplat.optics.retrieval.model import WaveModel
from holosplat.optics.retrieval.nonlinear import descend, objective, penalty_weights
from holosplat.optics.retrieval.spectra import (
    Raster,
    detector_transfer,
    response,
    spectra,
    squared_frequency,
)
from holosplat.scan import Exposures
from holosplat.units import wavelength, wavenumber

ENERGY = 20.0  # keV
LAMBDA, K = wavelength(ENERGY), wavenumber(ENERGY)
PITCH = 0.5e-6  # m
DELTA, BETA = 7.4e-7, 2.6e-10  # haemoglobin
CELL_DELTA, CELL_BETA = 2.7e-8, -1.5e-11
"""δ and β of a red cell minus plasma at 20 keV: it absorbs less than what surrounds it."""
DOUBLE = torch.float64
SHAPE = (63, 75)
HOLOGRAPHIC = 24.8 * PITCH**2 / LAMBDA  # m


def at(lambda_z: float) -> float:
    """The distance [m] at which λz is `lambda_z` squared pitches."""
    return lambda_z * PITCH**2 / LAMBDA


def exposures(shape: tuple[int, int] = SHAPE, distance=HOLOGRAPHIC, psf: float = 0.0, count: int = 1) -> Exposures:
    """Exposures from one side, with one or more distances [m]."""
    views = Views.from_angles([0.0] * count, shape, PITCH)
    return replace(Exposures.of(views, ENERGY, 1.0, psf), distance=np.broadcast_to(distance, count))


def pixels(views: Views) -> tuple[Tensor, Tensor]:
    """Coordinates of pixel centres [m]: x [1, W] and y [H, 1]."""
    h, w = views.shape
    x, y = ((torch.arange(n, dtype=DOUBLE) + 0.5 - n / 2) * views.pixel_size for n in (w, h))
    return x[None], y[:, None]


def gaussian(views: Views, height: float, sigma_px: float, centre_px: tuple[float, float] = (3.3, -5.2)) -> Tensor:
    """A Gaussian [H, W] of `height`."""
    x, y = pixels(views)
    return height * torch.exp(-0.5 * _squared_distance(x, y, centre_px) / (sigma_px * PITCH) ** 2)


def bodies(views: Views, radius_px: float = 8.0) -> Tensor:
    """Thickness [H, W] in metres of a ball and a flat ellipsoid beside it."""
    x, y = pixels(views)
    total = torch.zeros(views.shape, dtype=DOUBLE)
    for centre, flatness in (((-11.3, 5.2), 1.0), ((10.4, -6.7), 0.4)):
        inside = (radius_px * PITCH) ** 2 - _squared_distance(x, y, centre)
        total = total + 2 * flatness * inside.clamp_min(0).sqrt()
    return total


def _squared_distance(x: Tensor, y: Tensor, centre_px: tuple[float, float]) -> Tensor:
    return (x - centre_px[0] * PITCH) ** 2 + (y - centre_px[1] * PITCH) ** 2


def taken(
    thickness: Callable[[Views], Tensor], where: Exposures, delta: float = DELTA, beta: float = BETA
) -> tuple[Tensor, Tensor]:
    """Thickness [V, H, W], its means over pixels, and frames of it: float64, four samples to the pixel."""
    instrument = Instrument(where, 4, DOUBLE)
    lines = thickness(instrument.views).expand(len(where), -1, -1)
    fine = thickness(where.views.refined(4))
    means = torch.nn.functional.avg_pool2d(fine[None], 4)[0].expand(len(where), -1, -1)
    return means, instrument.image(lines * beta, lines * delta)


def noisy(frames: Tensor, photons: float, seed: int = 0) -> Tensor:
    """Counts over their mean."""
    counts = torch.poisson(frames * photons, generator=torch.Generator().manual_seed(seed))
    return counts / photons


def relative_error(found: Tensor, truth: Tensor) -> float:
    """Root mean square of the difference over that of the truth."""
    return float((found.double() - truth).norm() / truth.norm())


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


# --- through the waves --------------------------------------------------------------------------------------


def model_of(psf: float = 0.6, lambda_z: float = 12.0, ratio: float = 0.01, photons: float = 500.0) -> WaveModel:
    """Of noisy frames of the bodies, float64, at two distances."""
    where = exposures((33, 41), np.array([at(lambda_z), at(lambda_z / 2)]), psf, count=2)
    frames = noisy(taken(lambda v: bodies(v, 6.0), where, DELTA, ratio * DELTA)[1], photons)
    return WaveModel(frames, where, ratio, None)


@pytest.mark.parametrize("lambda_z", [12.0, 0.9])
def test_the_objectives_gradient(lambda_z):
    """Against central differences, along random directions; at λz = 0.9/2 with three samples to the pixel."""
    waves = model_of(lambda_z=lambda_z)
    assert waves.oversample == (1 if lambda_z > 5 else 3)
    weights = penalty_weights(waves, 1.0)
    generator = torch.Generator().manual_seed(3)
    phase = waves.phase + 0.2 * torch.rand(waves.phase.shape, dtype=DOUBLE, generator=generator)
    _, slope = objective(waves, phase, weights)
    for _ in range(3):
        way = torch.randn(phase.shape, dtype=DOUBLE, generator=generator)
        ahead, behind = (objective(waves, phase + s * 1e-5 * way, weights)[0] for s in (1, -1))
        expected = (slope * way).sum(dim=(1, 2))
        assert torch.allclose((ahead - behind) / 2e-5, expected, rtol=1e-6, atol=1e-9)


def test_every_step_lowers_the_objective():
    waves = model_of()
    phase, values = descend(waves, Tikhonov(iterations=30), lambda fraction: None)
    assert bool((values[1:] <= values[:-1]).all())
    assert bool((values[-1] < 0.8 * values[0]).all())
    assert float(phase.min()) >= 0
    assert float((phase * (1 - waves.support)).abs().max()) == 0


def test_the_estimate_keeps_its_means_on_a_finer_raster():
    waves = model_of(lambda_z=0.9, photons=1e9)
    where = waves.exposures
    estimate = bounded_estimate(waves.frames, where, 0.01, None)
    inside = waves.thickness(waves.phase, DELTA) * K * DELTA
    assert relative_error(inside, estimate.phase) < 0.02  # what bounds cut off


@pytest.mark.parametrize("shape", [(7, 9), (8, 12)])
def test_slopes_and_their_adjoint(shape):
    generator = torch.Generator().manual_seed(2)
    images = torch.randn(3, *shape, dtype=DOUBLE, generator=generator)
    slopes = torch.randn(2, 3, *shape, dtype=DOUBLE, generator=generator)
    assert float((gradient(images) * slopes).sum()) == pytest.approx(float((images * gradient_adjoint(slopes)).sum()))
    by_spectrum = torch.fft.irfft2(torch.fft.rfft2(images) * _laplacian(shape), s=shape)
    assert torch.allclose(gradient_adjoint(gradient(images)), by_spectrum, atol=1e-12)


def test_projection_on_the_amplitude_never_wraps():
    """A phase of 30 rad whose frame is the measured one is a fixed point; a wrapped one would come back below π."""
    where = exposures((61, 75), at(3.0))
    truth, frames = taken(lambda v: gaussian(v, 400e-6, 12.0, (0.0, 0.0)), where, DELTA, 0.002 * DELTA)
    waves = WaveModel(frames, where, 0.002, 0.0)
    phase = gaussian(where.views.padded(waves.margin), 30.0, 12.0, (0.0, 0.0))[None]
    assert float(truth.max()) * K * DELTA == pytest.approx(float(phase.max()), rel=0.02)
    waves.amplitude = waves.image(phase).sqrt()
    assert torch.allclose(through_detector(waves, phase), phase, atol=1e-9)
    nearly = phase + gaussian(where.views.padded(waves.margin), 0.3, 4.0)[None]
    assert float((through_detector(waves, nearly) - phase).abs().max()) < 0.35


def test_projection_on_one_material(monkeypatch):
    """Where only the amplitude is found wrong, by `exp(-r Δ)`, the nearest phase is `φ + r² Δ / (1 + r²)`."""
    waves, ratio, change = model_of(ratio=0.5), 0.5, 0.2
    gain = torch.full(waves.phase.shape, math.exp(-ratio * change), dtype=DOUBLE)
    monkeypatch.setattr(iterative, "_gain", lambda model, phase: gain)
    phase = torch.full_like(waves.phase, 3.0)
    expected = 3.0 + ratio**2 * change / (1 + ratio**2)
    assert torch.allclose(through_detector(waves, phase), torch.full_like(phase, expected), atol=1e-12)


def test_reduction_brings_amplitudes_nearer():
    """Gerchberg–Saxton reduces the error (Fienup 1982, section III), up to its bounds' part in it."""
    waves = model_of(psf=0.0)
    before = waves.misfit(waves.phase)[0]
    phase = waves.phase
    for _ in range(20):
        phase = waves.bounded(through_detector(waves, phase))
    assert bool((waves.misfit(phase)[0] < 0.9 * before).all())


def test_feedback_makes_the_difference_to_error_reduction():
    where = exposures((33, 41))
    frames = noisy(taken(lambda v: bodies(v, 6.0), where)[1], 2000.0)
    without = hybrid_input_output(frames, where, DELTA, BETA, options=Projections(iterations=9, feedback=0.0))
    reduced, hybrid = (
        f(frames, where, DELTA, BETA, options=Projections(iterations=9))
        for f in (gerchberg_saxton, hybrid_input_output)
    )
    assert not torch.equal(reduced, hybrid)
    assert not torch.equal(without, hybrid)


# --- every method -------------------------------------------------------------------------------------------

METHODS = pytest.mark.parametrize("name", RETRIEVALS)

CLEAN = dict(zip(RETRIEVALS, (0.29, 0.12, 0.04, 0.04, 0.042, 0.028)))
"""Bounds of the relative error of a ball and an ellipsoid without noise: about a fourth above what is found."""
NOISY = dict(zip(RETRIEVALS, (0.95, 0.62, 0.16, 0.1, 0.14, 0.19)))
"""The same with 2000 photons a pixel. The second exposure, at half the distance, has half the contrast."""


@pytest.fixture(scope="module")
def ball() -> tuple[Exposures, Tensor, Tensor]:
    """Two exposures, the bodies' thickness and frames: holographic, 0.5 µm pixels, the second at half the distance."""
    where = exposures(distance=np.array([at(24.8), at(12.4)]), count=2)
    return where, *taken(bodies, where)


@METHODS
@pytest.mark.parametrize("photons", [None, 2000.0])
def test_bodies_are_found(name, photons, ball):
    where, truth, frames = ball
    frames = frames if photons is None else noisy(frames, photons)
    found = RETRIEVALS[name](frames.float(), where, DELTA, BETA)
    error = relative_error(found, truth)
    assert error < (CLEAN if photons is None else NOISY)[name]


@METHODS
def test_blurred_frames(name, ball):
    """A point-spread function of 0.7 px, and one of 0.2 px in the second exposure, are known and undone."""
    where = replace(ball[0], psf_sigma_px=np.array([0.7, 0.2]))
    truth, frames = taken(bodies, where)
    told = relative_error(RETRIEVALS[name](frames.float(), where, DELTA, BETA), truth)
    untold = relative_error(RETRIEVALS[name](frames.float(), ball[0], DELTA, BETA), truth)
    assert told < untold


@pytest.mark.parametrize("name", [name for name in RETRIEVALS if name not in ("paganin", "ctf")])
def test_the_waves_beat_the_filters(name, ball):
    """Paganin's plain filter is the least that the others must beat, by a factor of two here."""
    where, truth, frames = ball
    plain = paganin(frames, where, DELTA, BETA, options=Linear(noise=0.0))
    assert relative_error(RETRIEVALS[name](frames.float(), where, DELTA, BETA), truth) < 0.5 * relative_error(
        plain, truth
    )


@METHODS
def test_negative_contrast_of_absorption(name):
    """Cells in plasma: β < 0, a phase of a fiftieth of a radian, λz = 62 squared pitches."""
    where = exposures(distance=at(62.0))
    truth, frames = taken(bodies, where, CELL_DELTA, CELL_BETA)
    found = RETRIEVALS[name](frames.float(), where, CELL_DELTA, CELL_BETA)
    assert relative_error(found, truth) < (0.65 if name in ("paganin", "ctf") else 0.2)


@METHODS
def test_each_view_is_on_its_own(name, ball, monkeypatch):
    """One by one, all at once, or as many at a time as memory is meant for: the same, and the same again."""
    where, _, frames = ball
    retrieve, frames = RETRIEVALS[name], noisy(frames, 2000.0).float()
    together = retrieve(frames, where, DELTA, BETA)
    assert together.shape == frames.shape
    assert together.dtype == frames.dtype
    assert torch.equal(together, retrieve(frames, where, DELTA, BETA))
    scale = float(together.abs().max())
    for v in range(2):
        alone = retrieve(frames[v : v + 1], where[[v]], DELTA, BETA)
        assert float((alone[0] - together[v]).abs().max()) < 0.01 * scale
    monkeypatch.setattr(model, "MOST_SAMPLES", 1)
    assert float((retrieve(frames, where, DELTA, BETA) - together).abs().max()) < 0.01 * scale


@METHODS
def test_single_precision_suffices(name, ball):
    where, truth, frames = ball
    frames = noisy(frames, 2000.0)
    found = [RETRIEVALS[name](f, where, DELTA, BETA) for f in (frames.float(), frames)]
    assert found[1].dtype == DOUBLE
    assert relative_error(found[0], truth) == pytest.approx(relative_error(found[1], truth), abs=0.01)


@METHODS
def test_nothing_is_found_in_empty_frames(name):
    where = exposures((31, 45))
    assert float(RETRIEVALS[name](torch.ones(1, 31, 45), where, DELTA, BETA).abs().max()) < 1e-9
    noise = noisy(torch.ones(1, 31, 45, dtype=DOUBLE), 1e4).float()
    assert float(RETRIEVALS[name](noise, where, DELTA, BETA).abs().mean()) < 0.3e-6  # a twentieth of a cell


@METHODS
def test_matter_may_leave_the_frame(name):
    """A body across the border is found to be there, and its other half does not wrap around to the far side."""
    where = exposures((63, 75))
    truth, frames = taken(lambda v: bodies(v, 8.0) + gaussian(v, 4e-6, 5.0, (37.0, 12.0)), where)
    found = RETRIEVALS[name](frames.float(), where, DELTA, BETA)
    assert float(found[0, 40:48, :4].abs().mean()) < 0.5e-6
    assert relative_error(found, truth) < 0.75


@METHODS
def test_progress_is_told(name):
    seen: list[float] = []
    RETRIEVALS[name](torch.ones(2, 15, 17), exposures((15, 17), count=2), DELTA, BETA, on_progress=seen.append)  # type: ignore[call-arg]
    assert seen[0] == 0
    assert seen == sorted(seen)
    assert seen[-1] <= 1


@METHODS
def test_bad_input_is_named(name):
    retrieve, where, frames = RETRIEVALS[name], exposures((15, 17)), torch.ones(1, 15, 17)
    with pytest.raises(InputError, match="δ > 0"):
        retrieve(frames, where, -1e-7, BETA)
    with pytest.raises(InputError, match="frames must have the shape"):
        retrieve(torch.ones(2, 15, 17), where, DELTA, BETA)
    with pytest.raises(InputError, match="float32 or float64"):
        retrieve(torch.ones(1, 15, 17, dtype=torch.int32), where, DELTA, BETA)
    with pytest.raises(InputError, match="finite"):
        retrieve(frames * math.nan, where, DELTA, BETA)


@pytest.mark.parametrize("options", [Linear, Tikhonov, Projections, ADMM])
def test_bad_options_are_named(options):
    with pytest.raises(InputError, match="noise must not be negative"):
        options(noise=-0.1)


def test_bad_numbers_of_options():
    for make in (lambda: Tikhonov(iterations=0), lambda: ADMM(iterations=0), lambda: Projections(iterations=0)):
        with pytest.raises(InputError, match="iterations"):
            make()
    with pytest.raises(InputError, match="decay"):
        Prior(decay=0.0)
    with pytest.raises(InputError, match="feedback"):
        Projections(feedback=-1.0)
    assert tikhonov is RETRIEVALS["tikhonov"]
    assert admm is RETRIEVALS["admm"]
