"""From line integrals to the wave in the detector plane (signs: docs/conventions.md)."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from ..units import wavelength, wavenumber


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


def fresnel_propagate(wave: Tensor, transfer: Tensor) -> Tensor:
    """`wave` [..., H, W] after free space with `transfer` [..., H, W]; periodic, so pass `U - 1` on a padded raster."""
    return torch.fft.ifft2(torch.fft.fft2(wave) * transfer)


def fresnel_reach_px(pitch: float, distance: float, energy_kev: float) -> int:
    """How far [pixels of `pitch` m] the finest resolved fringe travels sideways: λz/(2p²), rounded up."""
    return math.ceil(wavelength(energy_kev) * abs(distance) / (2 * pitch**2))
