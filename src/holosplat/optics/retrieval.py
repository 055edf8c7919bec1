"""Phase retrieval of single views for one material: intensity → projected thickness."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from ..checks import require
from ..units import wavelength, wavenumber

WEAKEST_ABSORPTION = 1e-4
"""|β|/δ assumed at least: it sets the lowest frequencies that retrieval trusts."""


FEEBLE_FLOOR = 1e-3
"""α/(2kδ) of the inversion where absorption is no help: frequencies below χ = 0.001 are damped."""


def retrieve_thickness(
    frames: Tensor, pitch: float, distance: np.ndarray, energy_kev: float, delta: float, beta: float
) -> Tensor:
    """Projected thickness [V, H, W] in metres of a single material (δ, β) from frames [V, H, W] at distances [V].

    Paganin et al. (2002), eq. 12: `T = -ln(F⁻¹[F[I] / (1 + πλz (δ/β) f²)]) / 2kβ`. A contrast with β ≤ 0 (cells
    in plasma) has no such filter and is solved in the linear limit (`invert_contrast`). Frames are continued by
    their edge values; pitch: pixel size [m]; δ must be positive.
    """
    require(delta > 0, f"phase retrieval needs a material with δ > 0, but δ is {delta:g}.")
    if beta < WEAKEST_ABSORPTION * delta:
        return invert_contrast(frames - 1, pitch, distance, energy_kev, delta, beta)
    padded, crop = _continued(frames, pitch, distance, energy_kev, delta, beta, "replicate")
    f2 = _squared_frequency(padded.shape, pitch)
    lam_z = wavelength(energy_kev) * np.asarray(distance, dtype=np.float64)[:, None, None]
    low_pass = torch.from_numpy(1 / (1 + np.pi * lam_z * (delta / beta) * f2))
    contact = torch.fft.irfft2(torch.fft.rfft2(padded) * low_pass, s=padded.shape[-2:])
    return (-torch.log(contact.clamp_min(1e-6)) / (2 * wavenumber(energy_kev) * beta))[crop].to(frames.dtype)


def invert_contrast(
    contrast: Tensor, pitch: float, distance: np.ndarray, energy_kev: float, delta: float, beta: float
) -> Tensor:
    """Thickness (change) [V, H, W] in metres of a single material that explains an intensity change [V, H, W].

    The linear response of a thin object is `F[I - 1] = -H F[T]`, `H = 2k (β cos χ + δ sin χ)`, `χ = πλz f²`
    (Cloetens et al. 1999, eq. 3, for φ and absorption of one material). It is inverted as `H / (H² + α²)` with
    α small up to the first maximum (χ = π/2) and a third of the peak response beyond, where zeros follow.
    Beyond the frame the contrast is taken as zero: a residual continued by its edge values would be blown up.
    """
    padded, crop = _continued(contrast, pitch, distance, energy_kev, delta, beta, "constant")
    lam_z = wavelength(energy_kev) * np.asarray(distance, dtype=np.float64)[:, None, None]
    chi = np.pi * lam_z * _squared_frequency(padded.shape, pitch)
    k2 = 2 * wavenumber(energy_kev)
    response = k2 * (beta * np.cos(chi) + delta * np.sin(chi))
    floor = k2 * np.where(chi < 0.5 * np.pi, WEAKEST_ABSORPTION * delta, 0.3 * delta)
    if beta < WEAKEST_ABSORPTION * delta:  # the lowest frequencies say next to nothing, or change their sign
        floor = np.maximum(floor, k2 * max(abs(beta), FEEBLE_FLOOR * delta))
    inverse = torch.from_numpy(-response / (response**2 + floor**2))
    solved = torch.fft.irfft2(torch.fft.rfft2(padded) * inverse, s=padded.shape[-2:])
    return solved[crop].to(contrast.dtype)


def _continued(
    frames: Tensor,
    pitch: float,
    distance: np.ndarray,
    energy_kev: float,
    delta: float,
    beta: float,
    mode: str,
) -> tuple[Tensor, tuple[slice, slice, slice]]:
    """Frames in float64, continued by twice the filter's length (torch's `mode`), and the slices that undo it."""
    absorption = max(abs(beta), WEAKEST_ABSORPTION * delta)
    reach = math.sqrt(wavelength(energy_kev) * float(np.max(distance)) * delta / absorption / math.pi)
    h, w = frames.shape[-2:]
    my, mx = (min(n - 1, math.ceil(2 * reach / pitch)) for n in (h, w))
    padded = pad(frames[None].double(), (mx, mx, my, my), mode=mode)[0]
    return padded, (slice(None), slice(my, my + h), slice(mx, mx + w))


def _squared_frequency(shape: torch.Size, pitch: float) -> np.ndarray:
    """`fx² + fy²` [H, W//2 + 1] in 1/m² (for `rfft2`)."""
    fy, fx = np.fft.fftfreq(shape[-2], pitch), np.fft.rfftfreq(shape[-1], pitch)
    return fy[:, None] ** 2 + fx[None] ** 2
