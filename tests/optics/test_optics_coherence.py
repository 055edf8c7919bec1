"""Source size by fringe visibility, cone beams by the Fresnel scaling theorem, spectra by closed forms."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from holosplat.checks import InputError
from holosplat.geometry import Views
from holosplat.model import Instrument
from holosplat.optics.coherence import FWHM, Spectrum, effective_geometry, joined_blur_px, source_blur
from holosplat.scan import Exposures
from holosplat.units import wavelength, wavenumber

ENERGY = 20.0


def exposures(shape: tuple[int, int], pixel: float, distance: float, psf_px: float = 0.0) -> Exposures:
    return Exposures.of(Views.from_angles([0.0], shape, pixel), ENERGY, distance, psf_px)


# --- source size


@pytest.mark.parametrize(("period_px", "source"), [(12.0, 40e-6), (7.3, 25e-6), (30.0, 90e-6)])
def test_two_beam_fringes_lose_visibility_as_the_sources_transform(period_px, source):
    """Two plane waves of equal strength: visibility exp(-2π²σ²f²) with σ = σ_s z/z₁ (van Cittert–Zernike).

    The source is summed point by point: one at angle θ shifts the fringes by θ z.
    """
    z1, z, pixel = 25.0, 0.4, 1e-6
    f = 1 / (period_px * pixel)
    x = np.arange(1000) * 0.01 * period_px * pixel  # ten periods
    points, weights = np.polynomial.hermite.hermgauss(60)
    angles = np.sqrt(2) * source * points / z1
    summed = sum(w * (1 + np.cos(2 * np.pi * f * (x - a * z))) for w, a in zip(weights / weights.sum(), angles))
    visibility = 2 * abs((summed * np.exp(-2j * np.pi * f * x)).mean()) / summed.mean()
    sigma = source_blur(source, z1, z)
    assert visibility == pytest.approx(np.exp(-2 * np.pi**2 * sigma**2 * f**2), rel=1e-9)
    assert 0.05 < visibility < 0.96


def test_holograms_of_a_source_are_the_mean_of_its_points():
    """Tilted plane waves through an object, propagated one by one, against the point-spread function of the source."""
    shape, pixel, distance, z1, source = (33, 44), 1e-6, 0.05, 20.0, 300e-6
    fine = exposures(shape, pixel, distance)
    blur_px = float(source_blur(source, z1, distance) / pixel)
    blurred = exposures(shape, pixel, distance, float(joined_blur_px(0.3, blur_px * pixel, pixel)))
    plain = Instrument(fine, 2, torch.float64)
    y, x = ((np.arange(n) + 0.5 - n / 2) * plain.views.pixel_size for n in plain.views.shape)
    delta = 1e-11 * np.exp(-((x - 2e-6) ** 2) / 4e-11 - y[:, None] ** 2 / 2e-11)
    lines = torch.from_numpy(delta)[None]
    none = torch.zeros_like(lines)
    whole = Instrument(blurred, 2, torch.float64)
    dy, dx = ((b - a) * 2 for a, b in zip(plain.margin, whole.margin))
    lines_whole = torch.nn.functional.pad(lines, (dx, dx, dy, dy))
    wanted = whole.image(torch.zeros_like(lines_whole), lines_whole)[0].numpy()
    # A tilt by θ shifts the hologram by θ z: the object is shifted the other way, all else alike.
    points, weights = np.polynomial.hermite.hermgauss(9)
    sigma = np.sqrt(2) * np.hypot(blur_px, 0.3) * pixel
    total = np.zeros(shape)
    spectrum = torch.fft.fft2(lines)
    fy, fx = (torch.fft.fftfreq(n, plain.views.pixel_size, dtype=torch.float64) for n in plain.views.shape)
    for p, wp in zip(points, weights):
        for q, wq in zip(points, weights):
            ramp = torch.exp(-2j * np.pi * sigma * (p * fy[:, None] + q * fx))
            moved = torch.fft.ifft2(spectrum * ramp).real
            total += wp * wq / np.pi * plain.image(none, moved)[0].numpy()
    assert np.ptp(wanted) > 0.02
    assert np.abs(total - wanted).max() < 2e-3 * np.ptp(wanted)


def test_blurs_add_in_quadrature_and_the_source_counts_at_its_distance():
    assert source_blur(30e-6, 3.0, np.array([0.1, 0.2])) == pytest.approx([1e-6, 2e-6])
    assert joined_blur_px(0.6, 1.6e-6, 2e-6) == pytest.approx(1.0)
    with pytest.raises(InputError, match="source distance must lie between"):
        source_blur(1e-6, 1e9, 0.1)


# --- magnification


def test_a_spherical_wave_is_a_parallel_beam_of_effective_pixel_and_distance():
    """Kirchhoff–Fresnel integrals from a point source, summed directly, against the parallel beam of the theorem."""
    z1, z2, detector_pixel, shape = 0.30, 0.45, 2.5e-6, (21, 31)
    found = effective_geometry(z1, z2, detector_pixel)
    assert (found.magnification, found.pixel_size) == pytest.approx((2.5, 1e-6))
    assert 1 / found.distance == pytest.approx(1 / z1 + 1 / z2)
    instrument = Instrument(exposures(shape, found.pixel_size, found.distance), 3, torch.float64)
    y, x = ((np.arange(n) + 0.5 - n / 2) * instrument.views.pixel_size for n in instrument.views.shape)

    def path(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Integral of δ along the beam [m] of an uneven body off the axis."""
        return 6e-12 * np.exp(-((x - 2e-6) ** 2) / 1.8e-11 - (y + 1e-6) ** 2 / 0.9e-11)

    lines = torch.from_numpy(path(x, y[:, None]))[None]
    frame = instrument.image(torch.zeros_like(lines), lines)[0].numpy()

    lam, step = wavelength(ENERGY), 0.1e-6
    v, u = np.arange(-14e-6, 12e-6, step), np.arange(-16e-6, 20e-6, step)
    body = np.exp(-1j * wavenumber(ENERGY) * path(u, v[:, None])) - 1
    spherical = np.exp(1j * np.pi / (lam * z1) * u**2), np.exp(1j * np.pi / (lam * z1) * v**2)
    inside = np.linspace(-1, 1, 7)[1::2] / 2 * detector_pixel  # the pixel's 3 × 3 samples, as the instrument takes them
    worst = 0.0
    for i, j in [(10, 15), (8, 19), (3, 5), (16, 22), (20, 30), (10, 21)]:
        seen = []
        for a in inside:
            for b in inside:
                X, Y = (j + 0.5 - shape[1] / 2) * detector_pixel + b, (i + 0.5 - shape[0] / 2) * detector_pixel + a
                kernels = [
                    np.exp(1j * np.pi / (lam * z2) * (c - w) ** 2) * s for c, w, s in zip((X, Y), (u, v), spherical)
                ]
                scattered = kernels[1] @ body @ kernels[0] * step**2
                # The free wave's integral: ∫exp(iπ(u²/z₁ + (X-u)²/z₂)/λ) du = √(iλ z_eff) exp(iπX²/λ(z₁+z₂)).
                free = 1j * lam * found.distance * np.exp(1j * np.pi * (X**2 + Y**2) / (lam * (z1 + z2)))
                seen.append(abs(1 + scattered / free) ** 2)
        worst = max(worst, abs(np.mean(seen) - frame[i, j]))
    assert np.ptp(frame) > 0.1
    assert worst < 2e-3 * np.ptp(frame)


def test_a_far_source_magnifies_nothing():
    found = effective_geometry(1e5, 0.1, 1e-6)
    assert (found.magnification, found.distance, found.pixel_size) == pytest.approx((1, 0.1, 1e-6), rel=1e-5)


# --- spectrum


@pytest.mark.parametrize(("bandwidth", "count"), [(0.002, 3), (0.02, 7)])
def test_a_gaussian_spectrum_has_its_moments(bandwidth, count):
    light = Spectrum.gaussian(ENERGY, bandwidth, count)
    offset = light.energies_kev / ENERGY - 1
    width = bandwidth / FWHM
    assert light.weights.sum() == pytest.approx(1)
    moments = [float(light.weights @ offset**n) for n in (1, 2, 3, 4)]
    assert moments == pytest.approx([0, width**2, 0, 3 * width**4], abs=1e-12 * bandwidth)
    assert light.mean_kev == pytest.approx(ENERGY)


def test_bandwidth_damps_weak_fringes_as_their_mean_over_wavelengths():
    """The contrast sin(πλz f²) of a weak phase grating, averaged over a Gaussian in λ: times exp(-(πz f²σ_λ)²/2)."""
    z, bandwidth, lam = 0.5, 0.02, wavelength(ENERGY)
    f = np.sqrt(15.5 / (lam * z))
    light = Spectrum.gaussian(ENERGY, bandwidth, 15)
    lams = np.array([wavelength(float(e)) for e in light.energies_kev])
    found = float(light.weights @ np.sin(np.pi * lams * z * f**2))
    damped = np.exp(-0.5 * (np.pi * z * f**2 * lam * bandwidth / FWHM) ** 2)
    assert 0.5 < damped < 0.95
    assert found == pytest.approx(damped * np.sin(np.pi * lam * z * f**2), rel=5e-3)


def test_lists_are_scaled_and_energies_without_light_go():
    light = Spectrum(np.array([10.0, 11.0, 12.0]), np.array([3.0, 0.0, 1.0]))
    assert light.energies_kev.tolist() == [10.0, 12.0]
    assert light.weights.tolist() == [0.75, 0.25]
    assert len(light) == 2


@pytest.mark.parametrize(
    ("energies", "weights", "said"),
    [
        ([], [], "at least one energy"),
        ([10.0], [1.0, 2.0], "spectrum weights must have the shape"),
        ([10.0, 11.0], [1.0, -1.0], "must not be negative"),
        ([10.0, 11.0], [0.0, 0.0], "nor all zero"),
        ([10.0, 1e5], [1.0, 1.0], "spectrum energy must lie between"),
        ([10.0, 11.0], [1.0, np.nan], "finite"),
    ],
)
def test_bad_spectra_are_named(energies, weights, said):
    with pytest.raises(InputError, match=said):
        Spectrum(np.array(energies), np.array(weights))
