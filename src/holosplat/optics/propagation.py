"""From line integrals to the wave in the detector plane, and from its intensity to a frame: pixel integration,
point-spread function, photon noise (signs: docs/conventions.md)."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from ..checks import positive
from ..units import wavelength, wavenumber

ANYWHERE = 1_000_000
"""Pixels that no frame has."""


def exit_wave_minus_one(B: Tensor, D: Tensor, energy_kev: float) -> Tensor:
    """`U - 1` behind the object, complex [..., H, W], with `U = exp(-k B - i k D)` (B, D in metres).

    Paganin (2006), *Coherent X-Ray Optics*, eq. 2.39 (projection approximation). The real part is built as
    `expm1(-kB) cos φ - 2 sin²(φ/2)`, which keeps float32's digits for weak objects.
    """
    k = wavenumber(energy_kev)
    return exit_wave_of(k * B, k * D)


def exit_wave_of(loss: Tensor, phase: Tensor) -> Tensor:
    """`exp(-loss - i phase) - 1` of a loss of amplitude and a delay of phase, real [..., H, W], dimensionless."""
    amplitude = torch.exp(-loss)
    real = torch.expm1(-loss) - 2 * amplitude * torch.sin(0.5 * phase) ** 2
    return torch.complex(real, -amplitude * torch.sin(phase))


def exit_wave(B: Tensor, D: Tensor, energy_kev: float) -> Tensor:
    """The wave `U = exp(-k B - i k D)` behind the object, complex [..., H, W] (B, D in metres)."""
    return exit_wave_minus_one(B, D, energy_kev) + 1


def fresnel_transfer(
    shape: tuple[int, int], pitch: float, distance: np.ndarray, energy_kev: float, dtype: torch.dtype
) -> Tensor:
    """Fresnel transfer functions `exp(-iπλz(fx² + fy²))`, complex [V, H, W], at distances [V] [m].

    See `fresnel_factors`.
    """
    lam_z = wavelength(energy_kev) * np.asarray(distance, dtype=np.float64).reshape(-1)
    rows, columns = fresnel_factors(shape, pitch, torch.from_numpy(lam_z), torch.complex128)
    return (rows[:, :, None] * columns[:, None]).to(dtype)


def fresnel_factors(
    shape: tuple[int, int], pitch: float, wavelengths_distances: Tensor, dtype: torch.dtype
) -> tuple[Tensor, Tensor]:
    """The factors `exp(-iπλz fy²)` [V, H] and `exp(-iπλz fx²)` [V, W] of the transfer functions, complex.

    Goodman (2005), *Introduction to Fourier Optics*, eq. 4-20, without the constant `exp(ikz)`. pitch: of the samples
    [m]; wavelengths_distances: [V] products λz [m²], float64, whose gradient the factors pass on. The phase is built
    in float64 whatever `dtype` (complex64 or complex128) is asked for. Frequencies that would travel further than half
    the raster (`|λ z f| > N p / 2`) are cut, since they could only alias (Matsushima & Shimobaba 2009, eq. 13); a
    raster padded by `fresnel_reach_px` loses none. The gradient takes the cut as it is.
    """
    lam_z, factors = wavelengths_distances.reshape(-1, 1), []
    for n in shape:
        f = torch.fft.fftfreq(n, pitch, dtype=torch.float64, device=lam_z.device)
        kept = (lam_z * f).abs() <= 0.5 * n * pitch * (1 + 1e-9)
        factors.append((torch.exp(-1j * math.pi * lam_z * f**2) * kept).to(dtype))
    return factors[0], factors[1]


def beyond_paraxial(f2: Tensor, wavelengths: Tensor, distances: Tensor) -> Tensor:
    """Phase [V, ...] that the Fresnel kernel `exp(-iπλz f²)` leaves out at squared frequencies f2 [...] [1/m²].

    The angular spectrum `exp(iz(√(k² - kx² - ky²) - k))` (Goodman 2005, eq. 3-74) is the Fresnel kernel times
    `exp(-i phase)`. With s = λ²f² it is `k z s² / 2(1 + √(1 - s))²`, about `πλ³z f⁴/4`, free of cancellation; for waves
    that fade (s > 1) that at s = 1. wavelengths, distances: [V] [m], float64, whose gradients pass on.
    """
    lam, z = (given.reshape(-1, *(1,) * f2.ndim) for given in (wavelengths, distances))
    s = (lam**2 * f2).clamp_max(1.0)
    return math.pi * z / lam * (s / (1 + torch.sqrt(1 - s))) ** 2


def needs_angular_spectrum(
    raster: tuple[int, int], pitch: float, wavelengths: np.ndarray, distances: np.ndarray
) -> bool:
    """Whether the Fresnel kernel is wrong by more than the rounding of the float32 transforms around it.

    The error is `beyond_paraxial` at the highest frequency that both axes of the raster of samples of `pitch` [m] keep
    (`fresnel_factors`). Rounding of a transform of N samples is about ε log₂ N (Gentleman & Sande 1966, AFIPS 29, 563).
    """
    lam, z = np.broadcast_arrays(np.atleast_1d(wavelengths), np.atleast_1d(np.abs(distances)))
    seen = [np.minimum(0.5 / pitch, 0.5 * n * pitch / np.maximum(lam * z, 1e-300)) for n in raster]
    s = np.minimum(lam**2 * (seen[0] ** 2 + seen[1] ** 2), 1.0)
    phase = np.pi * z / lam * (s / (1 + np.sqrt(1 - s))) ** 2
    return bool(phase.max() > np.finfo(np.float32).eps * math.log2(math.prod(raster)))


def transfer_phase(
    f2: Tensor, raster: tuple[int, int], pitch: float, distance: np.ndarray, energy_kev: np.ndarray
) -> Tensor:
    """`χ` [V, ...] by which free space turns waves of squared frequencies f2 [...] [1/m²] back, float64: πλz f², and
    what `beyond_paraxial` adds where `needs_angular_spectrum`."""
    lam = wavelength(energy_kev)
    chi = math.pi * torch.from_numpy(lam * distance).reshape(-1, *(1,) * f2.ndim) * f2
    if not needs_angular_spectrum(raster, pitch, lam, distance):
        return chi
    return chi + beyond_paraxial(f2, torch.from_numpy(lam), torch.from_numpy(distance))


def angular_spectrum_factor(
    raster: tuple[int, int], pitch: float, wavelengths: Tensor, distances: Tensor, dtype: torch.dtype
) -> Tensor:
    """What the product of `fresnel_factors` lacks of the angular spectrum, complex [V, H, W] of `dtype`.

    wavelengths, distances: [V] [m], float64, whose gradients pass on. Waves that fade are cut, and those that would
    travel further than half the raster, which at steep angles is further than `fresnel_factors` says.
    """
    fy, fx = (torch.fft.fftfreq(n, pitch, dtype=torch.float64, device=distances.device) for n in raster)
    f2 = fy[:, None] ** 2 + fx**2
    lam, z = wavelengths[:, None, None], distances.detach()[:, None, None]
    cosine = torch.sqrt((1 - lam**2 * f2).clamp_min(1e-300))
    kept = lam**2 * f2 < 1
    for f, n in ((fy[:, None], raster[0]), (fx, raster[1])):
        kept = kept & ((lam * z * f).abs() <= 0.5 * n * pitch * cosine * (1 + 1e-9))
    return (torch.exp(-1j * beyond_paraxial(f2, wavelengths, distances)) * kept).to(dtype)


def fresnel_propagate(wave: Tensor, transfer: Tensor) -> Tensor:
    """`wave` [..., H, W] after free space with `transfer` [..., H, W]; periodic, so pass `U - 1` on a padded raster."""
    return torch.fft.ifft2(torch.fft.fft2(wave) * transfer)


def fresnel_reach_px(pitch: float, distance: float, energy_kev: float) -> int:
    """How far [pixels of `pitch` m] the finest resolved fringe travels sideways: z tan θ / p at sin θ = λ/2p, rounded
    up to a millionth of it; that is λz/(2p²) where angles are small. Where it fades, `ANYWHERE`."""
    sine = wavelength(energy_kev) / (2 * pitch)
    if sine >= 1:
        return ANYWHERE if distance else 0
    return math.ceil((1 - 1e-6) * abs(distance) * sine / (pitch * math.sqrt(1 - sine**2)))


def bin_pixels(image: Tensor, factor: int) -> Tensor:
    """[V, H·factor, W·factor] → [V, H, W]: the mean over each pixel's `factor × factor` samples."""
    return image if factor == 1 else avg_pool2d(image[None], factor)[0]


def gaussian_transfer(shape: tuple[int, int], sigma_px: np.ndarray, dtype: torch.dtype) -> Tensor:
    """Fourier transform of Gaussian point-spread functions, [V, H, W//2 + 1] (for `rfft2`); see `gaussian_factors`."""
    sigma = torch.from_numpy(np.asarray(sigma_px, dtype=np.float64))
    rows, columns = gaussian_factors(shape, sigma, torch.float64)
    return (rows[:, :, None] * columns[:, None, : shape[1] // 2 + 1]).to(dtype)


def gaussian_factors(shape: tuple[int, int], sigma_px: Tensor, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """The factors `exp(-2π²σ²fy²)` [V, H] and `exp(-2π²σ²fx²)` [V, W] of Gaussian point-spread functions' transforms.

    sigma_px: [V] standard deviations in samples of the raster `shape`, float64, whose gradient the factors pass on.
    They depend on σ², so the gradient is zero at σ = 0 exactly.
    """
    exponent, on = -2 * math.pi**2 * sigma_px.reshape(-1, 1) ** 2, sigma_px.device
    frequencies = (torch.fft.fftfreq(n, dtype=torch.float64, device=on) for n in shape)
    rows, columns = (torch.exp(exponent * f**2).to(dtype) for f in frequencies)
    return rows, columns


def blur(image: Tensor, transfer: Tensor) -> Tensor:
    """`image` [V, H, W] blurred (periodically) by the point-spread functions whose `rfft2` is `transfer`."""
    return torch.fft.irfft2(torch.fft.rfft2(image) * transfer, s=image.shape[-2:])


def poisson(intensity: np.ndarray, photons_per_pixel: float, seed: int | np.random.Generator) -> np.ndarray:
    """Relative intensity [..., H, W] with photon noise: Poisson counts of mean `I · photons_per_pixel`, divided by it.

    seed: a seed, or a generator to draw on: frames one by one then get the same noise as all at once.
    """
    photons = positive("photons_per_pixel", photons_per_pixel)
    counts = np.random.default_rng(seed).poisson(np.clip(intensity, 0, None) * photons)
    return (counts / photons).astype(np.float32)
