"""Wave optics against closed forms: exit wave, free space and detector."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.special import fresnel
from torch import Tensor

from helpers.waves import COMPLEX, DOUBLE, ENERGY, PITCH, SHAPE, Bump, K, at, exposures
from holosplat.checks import InputError
from holosplat.model import Instrument
from holosplat.optics import (
    bin_pixels,
    blur,
    exit_wave,
    exit_wave_minus_one,
    fresnel_propagate,
    fresnel_reach_px,
    fresnel_transfer,
    poisson,
)
from holosplat.optics.propagation import gaussian_transfer


def transfer(shape: tuple[int, int], lambda_z: float) -> Tensor:
    """The transfer function [1, H, W] in float64 for λz in squared pitches."""
    return fresnel_transfer(shape, PITCH, np.array([at(lambda_z)]), ENERGY, COMPLEX)


def noise_wave(shape: tuple[int, int], seed: int = 0) -> Tensor:
    """A random complex wave [1, H, W]."""
    return torch.randn(1, *shape, dtype=COMPLEX, generator=torch.Generator().manual_seed(seed))


# --- exit wave ----------------------------------------------------------------------------------------------


def test_exit_wave_of_a_slab():
    """Phase -kδt and contact intensity exp(-2kβt), that is μ = 2kβ."""
    delta, beta, t = 1e-6, 3e-9, torch.linspace(0, 3e-5, 35, dtype=DOUBLE).reshape(5, 7)
    wave = exit_wave(beta * t, delta * t, ENERGY)
    assert torch.allclose(wave.abs() ** 2, torch.exp(-2 * K * beta * t), rtol=1e-13)
    assert float(torch.angle(wave * torch.exp(1j * K * delta * t)).abs().max()) < 1e-12
    assert K * delta * float(t.max()) > 2  # the phase went far beyond what is weak
    assert float(torch.angle(wave)[0, 1]) < 0  # matter with δ > 0 advances the phase: negative here


def test_exit_wave_minus_one_keeps_float32_digits_of_weak_objects():
    """Real and imaginary part each to a few float32 roundings, where forming U first would leave none."""
    phase = torch.logspace(-7, 0, 15, dtype=DOUBLE)
    B, D = phase**2 / K, phase / K
    truth = torch.expm1(-K * B - 1j * K * D)
    wave = exit_wave_minus_one(B.float(), D.float(), ENERGY)
    for part, true in ((wave.real, truth.real), (wave.imag, truth.imag)):
        assert float(((part - true) / true).abs().max()) < 1e-6


# --- free space ---------------------------------------------------------------------------------------------


def slit(x: np.ndarray, half: float, lambda_z: float) -> np.ndarray:
    """Wave at x behind a slit |x| < half: `(1 - i)/2 [C + iS]`, Goodman (2005), section 4.5; in one unit."""
    scale = math.sqrt(2 / lambda_z)
    (s1, c1), (s2, c2) = (fresnel(scale * (edge - x)) for edge in (-half, half))
    return (0.5 - 0.5j) * ((c2 - c1) + 1j * (s2 - s1))


def edge_error(samples: int, kind: str) -> float:
    """Worst error of the mean intensity per pixel behind a rectangle of matter, `samples²` to the pixel."""
    halves, lambda_z = (12.5, 19.5), 40.0  # pixels; the raster leaves room for the finest fringes
    shape = tuple(int(2 * half + lambda_z * samples) for half in halves)
    B, D = {"opaque": (60 / K, 0.0), "phase": (0.0, 0.7 / K), "both": (0.1 / K, -1.3 / K)}[kind]
    fine = tuple(n * samples for n in shape)
    y, x = ((np.arange(n) + 0.5 - n / 2) / samples for n in fine)
    inside = torch.from_numpy((np.abs(y) < halves[0])[:, None] & (np.abs(x) < halves[1])).to(DOUBLE)[None]
    h = fresnel_transfer(fine, PITCH / samples, np.array([at(lambda_z)]), ENERGY, COMPLEX)
    wave = 1 + fresnel_propagate(exit_wave_minus_one(B * inside, D * inside, ENERGY), h)
    rows, columns = slit(y, halves[0], lambda_z), slit(x, halves[1], lambda_z)
    exact = 1 + (np.exp(-K * (B + 1j * D)) - 1) * rows[:, None] * columns[None]
    got, true = (bin_pixels(torch.as_tensor(u).abs().reshape(1, *fine) ** 2, samples)[0] for u in (wave, exact))
    assert float((true - 1).abs().max()) > 0.3  # there are fringes to get right
    (top, left) = (n // 2 - m for n, m in zip(shape, (20, 27)))
    return float((got - true)[top : top + 41, left : left + 55].abs().max())


@pytest.mark.parametrize("kind", ["opaque", "phase", "both"])
def test_fresnel_fringes_of_edges(kind):
    """A rectangle of matter has edges along both axes; its wave is a product of Fresnel integrals."""
    coarse, fine = edge_error(2, kind), edge_error(4, kind)
    assert fine < 0.01
    assert math.log2(coarse / fine) > 1.8  # edges between samples: second order


@pytest.mark.parametrize("turned", [False, True])
def test_a_grating_images_itself(turned):
    """Talbot: any periodic wave returns after 2a²/λ, and after a²/λ shifted by half a period."""
    period = 6
    line = noise_wave((1, period))[0].repeat(7, 13)  # [7, 78]
    wave = line.T[None] if turned else line[None]
    back = fresnel_propagate(wave, transfer(wave.shape[1:], 2 * period**2))
    half = fresnel_propagate(wave, transfer(wave.shape[1:], period**2))
    assert torch.allclose(back, wave, atol=1e-11)
    assert torch.allclose(half, wave.roll(period // 2, 1 if turned else 2), atol=1e-11)
    assert not torch.allclose(half, wave, atol=0.1)


def test_free_space_conserves_energy_and_turns_back():
    wave = noise_wave(SHAPE)
    there = fresnel_propagate(wave, transfer(SHAPE, 30.0))
    assert float(there.abs().square().sum()) == pytest.approx(float(wave.abs().square().sum()), rel=1e-13)
    assert torch.allclose(transfer(SHAPE, -30.0), transfer(SHAPE, 30.0).conj(), atol=1e-14)
    assert torch.allclose(fresnel_propagate(there, transfer(SHAPE, -30.0)), wave, atol=1e-12)
    assert float((there - wave).abs().max()) > 1


def test_two_steps_are_one():
    wave = noise_wave(SHAPE)
    steps = fresnel_propagate(fresnel_propagate(wave, transfer(SHAPE, 9.5)), transfer(SHAPE, 20.5))
    assert torch.allclose(steps, fresnel_propagate(wave, transfer(SHAPE, 30.0)), atol=1e-12)


@pytest.mark.parametrize("axis", [1, 2])
def test_a_tilted_wave_walks_sideways(axis):
    """A phase ramp of frequency f moves the pattern by λzf and changes nothing else."""
    n, cycles, step = SHAPE[axis - 1], 3, 2
    lambda_z = step * n / cycles  # so that λ z f is `step` samples
    bump = Bump(0.0, 1.0, 1.0, (1.3 * PITCH, -2.1 * PITCH)).depth(exposures().views).to(COMPLEX)
    ramp = torch.exp(2j * torch.pi * cycles / n * torch.arange(n, dtype=DOUBLE))
    ramp = ramp[:, None] if axis == 1 else ramp[None]
    straight, tilted = (fresnel_propagate(u, transfer(SHAPE, lambda_z)).abs() for u in (bump, bump * ramp))
    assert torch.allclose(tilted, straight.roll(step, axis), atol=1e-7)


@pytest.mark.parametrize(("rows", "columns"), [(0, 5), (3, 0), (7, 11)])
@pytest.mark.parametrize("lambda_z", [2.0, 11.0, 29.0])
def test_contrast_of_weak_objects(rows, columns, lambda_z):
    """I - 1 = 2φ sin χ - 2kB cos χ with χ = πλz f² (Cloetens et al. 1999, eq. 3) and φ = -kD."""
    h, w = SHAPE
    pattern = np.cos(2 * np.pi * (rows * np.arange(h)[:, None] / h + columns * np.arange(w)[None] / w))
    chi = np.pi * lambda_z * ((rows / h) ** 2 + (columns / w) ** 2)
    B, D = (torch.from_numpy(a * pattern / K)[None] for a in (3e-7, 2e-7))
    wave = 1 + fresnel_propagate(exit_wave_minus_one(B, D, ENERGY), transfer(SHAPE, lambda_z))
    contrast = -2 * (2e-7 * np.sin(chi) + 3e-7 * np.cos(chi)) * pattern
    assert np.allclose((wave.abs() ** 2 - 1)[0].numpy(), contrast, atol=1e-12)


def test_frequencies_that_leave_the_raster_are_cut():
    """|λzf| > Np/2 is cut; a raster padded by the reach of the finest fringe loses nothing."""
    far = transfer(SHAPE, 100.0)[0].abs()
    fy, fx = np.fft.fftfreq(SHAPE[0])[:, None], np.fft.fftfreq(SHAPE[1])[None]
    kept = (np.abs(100 * fy) <= SHAPE[0] / 2) & (np.abs(100 * fx) <= SHAPE[1] / 2)
    assert np.array_equal(far.numpy() > 0.5, kept)
    assert not kept.all()
    reach = fresnel_reach_px(PITCH, at(100.0), ENERGY)
    assert reach == 50
    padded = transfer((SHAPE[0] + 2 * reach, SHAPE[1] + 2 * reach), 100.0)
    assert torch.allclose(padded.abs(), torch.ones_like(padded.real))


def test_the_phase_of_the_transfer_is_exact_in_float32():
    """Thousands of turns of phase are built in float64, whatever type is asked for."""
    shape, distance = (2187, 3), np.array([at(2000.0)])
    single = fresnel_transfer(shape, PITCH, distance, ENERGY, torch.complex64)
    double = fresnel_transfer(shape, PITCH, distance, ENERGY, COMPLEX)
    assert single.dtype == torch.complex64
    assert float((single - double).abs().max()) < 1e-7


# --- detector -----------------------------------------------------------------------------------------------


def test_a_pixel_is_the_mean_of_its_samples():
    fine = torch.rand(2, 15, 21, dtype=DOUBLE)
    want = fine.reshape(2, 5, 3, 7, 3).mean((2, 4))
    assert torch.allclose(bin_pixels(fine, 3), want, atol=1e-15)
    assert bin_pixels(fine, 1) is fine


def test_point_spread_function_adds_variances():
    """Gaussian * Gaussian is a Gaussian of the summed variances and the same mass; each view has its own."""
    views, sigmas = exposures(count=3).views, np.array([0.0, 1.5, 3.2])
    sharp = Bump(0.0, 1.0, 1.0, (0.7 * PITCH, -1.9 * PITCH)).depth(views)
    blurred = blur(sharp, gaussian_transfer(SHAPE, sigmas, DOUBLE))
    for image, sigma, before in zip(blurred, sigmas, sharp):
        wide = (PITCH * math.hypot(2, sigma), PITCH * math.hypot(3, sigma))
        peak = 6 * PITCH**2 / (wide[0] * wide[1])
        closed = Bump(0.0, 1.0, peak, (0.7 * PITCH, -1.9 * PITCH), wide).depth(views.padded(SHAPE))[0]
        periodic = closed.reshape(3, SHAPE[0], 3, SHAPE[1]).sum((0, 2))
        assert torch.allclose(image, periodic, atol=2e-5)
        assert float(image.sum()) == pytest.approx(float(before.sum()), rel=1e-13)


def test_photon_noise():
    """Counts are Poisson: mean I and variance I/photons (1e5 samples, bounds of five standard errors)."""
    level, photons, n = 1.7, 40.0, 100_035
    noisy = poisson(np.full((3, 5, n // 15), level), photons, seed=7)
    variance = level / photons
    assert noisy.dtype == np.float32
    assert noisy.mean() == pytest.approx(level, abs=5 * math.sqrt(variance / n))
    assert noisy.var() == pytest.approx(variance, rel=5 * math.sqrt((2 + 1 / (level * photons)) / n))
    assert np.allclose(noisy * photons, np.round(noisy * photons), atol=1e-4)  # whole photons
    assert np.array_equal(noisy, poisson(np.full((3, 5, n // 15), level), photons, seed=7))
    assert not np.array_equal(noisy, poisson(np.full((3, 5, n // 15), level), photons, seed=8))


# --- bad input ----------------------------------------------------------------------------------------------


def test_bad_input_is_named():
    with pytest.raises(InputError, match="oversample must be at least 1"):
        Instrument(exposures(), 0)
    with pytest.raises(InputError, match="photons_per_pixel"):
        poisson(np.ones((1, 3, 5)), 0.0, 0)
    with pytest.raises(InputError, match="energy_kev"):
        exit_wave(torch.zeros(1), torch.zeros(1), -20.0)
