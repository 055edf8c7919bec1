"""Phase retrieval in one step, by a filter: Paganin's, and the contrast transfer function of one material."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from ...checks import require
from ...progress import Advance
from ...ranges import checked_dataclass
from ...scan import Exposures
from ...units import wavelength, wavenumber
from .bounded import completed
from .contact import or_in_contact
from .spectra import (
    Noise,
    Prior,
    Raster,
    absorption,
    checked,
    column,
    detector_transfer,
    filtered,
    fresnel_phase,
    radian,
    response,
    spectra,
    surrounded,
)

WEAKEST_ABSORPTION = 1e-4
"""|β|/δ assumed at least: it sets the lowest frequencies that retrieval trusts."""


FEEBLE_FLOOR = 1e-3
"""α/(2kδ) of the inversion where absorption is no help: frequencies below χ = 0.001 are damped."""

SHARP_EDGED = Prior()


@checked_dataclass
class Linear:
    """Options of the filters."""

    noise: Noise = None
    """Standard deviation of the frames, or their noise model (default: estimated from them; 0: none)."""
    model_error: float = 0.01
    """Part of the frames' contrast that no filter explains; it damps frequencies where the response is weak."""
    prior: Prior = SHARP_EDGED
    """Expected power of the phase."""


@or_in_contact
def paganin(
    frames: Tensor,
    exposures: Exposures,
    delta: float,
    beta: float,
    *,
    options: Linear = Linear(),
    missing: Tensor | None = None,
    two_sided: bool = False,
    on_progress: Advance = lambda fraction: None,
) -> Tensor:
    """Thickness [V, H, W] in metres of one material by the filter of Paganin et al. (2002), eq. 12.

    The plain filter (`retrieve_thickness`) divides noise by 2β/δ at low frequencies: 2000 photons a pixel leave
    nothing of a cell. Here it is Wiener's inverse of the same transport of intensity, `2 (β/δ + χ)`, for the noise
    that the frames have; with `noise=0` it is the plain one. A contrast with β/δ ≤ 0 has no such filter and is
    solved by `contrast_transfer`.
    """
    if beta / delta < WEAKEST_ABSORPTION and options.noise != 0:
        how = {"options": options, "missing": missing, "two_sided": two_sided, "on_progress": on_progress}
        return contrast_transfer(frames, exposures, delta, beta, **how)
    frames = checked(frames, exposures, delta)
    on_progress(0.0)
    if options.noise == 0:
        physics = (exposures.views.pixel_size, exposures.distance, exposures.energy_kev)
        return retrieve_thickness(frames, *physics, *exposures.refraction(delta, beta))
    contrast, crop = surrounded(frames, exposures)
    raster = Raster((contrast.shape[-2], contrast.shape[-1]), exposures.views.pixel_size)
    ratio = absorption(exposures, beta / delta)
    h = 2 * (ratio + fresnel_phase(exposures, raster)) * detector_transfer(exposures, raster)
    known = spectra(frames, exposures, h, raster, options.noise, options.model_error, options.prior, missing=missing)
    contrast = completed(contrast, missing, crop, known)
    contact = 1 + 2 * ratio * known.poses.sum(filtered(contrast, known.inverse))
    mu = column(2 * wavenumber(exposures.energy_kev) * exposures.refraction(delta, beta)[1])
    return (-torch.log(contact.clamp_min(1e-6)) / mu)[crop].to(frames.dtype)


@or_in_contact
def contrast_transfer(
    frames: Tensor,
    exposures: Exposures,
    delta: float,
    beta: float,
    *,
    options: Linear = Linear(),
    missing: Tensor | None = None,
    two_sided: bool = False,
    on_progress: Advance = lambda fraction: None,
) -> Tensor:
    """Thickness [V, H, W] in metres of one material, β of any sign, by its contrast transfer function.

    Cloetens et al. (1999), eq. 3; right for weak objects at any distance. Where others add a constant to the
    denominator, one below and one above the first maximum (Yu et al. 2018), this is Wiener's inverse: the constant
    is the noise of the frames over the power expected of the phase, and differs from frequency to frequency.
    """
    frames = checked(frames, exposures, delta)
    on_progress(0.0)
    contrast, crop = surrounded(frames, exposures)
    raster = Raster((contrast.shape[-2], contrast.shape[-1]), exposures.views.pixel_size)
    h = response(exposures, beta / delta, raster)
    known = spectra(frames, exposures, h, raster, options.noise, options.model_error, options.prior, missing=missing)
    contrast = completed(contrast, missing, crop, known)
    return (-known.poses.sum(filtered(contrast, known.inverse)) * radian(exposures, delta))[crop].to(frames.dtype)


PerView = float | np.ndarray
"""One number for all views, or one for each [V]."""


def retrieve_thickness(
    frames: Tensor, pitch: float, distance: np.ndarray, energy_kev: PerView, delta: PerView, beta: PerView
) -> Tensor:
    """Projected thickness [V, H, W] in metres of a single material (δ, β) from frames [V, H, W] at distances [V].

    energy_kev, delta, beta: of all views, or of each [V].

    Paganin et al. (2002), eq. 12: `T = -ln(F⁻¹[F[I] / (1 + πλz (δ/β) f²)]) / 2kβ`. A contrast with β/δ ≤ 0 (cells
    in plasma) has no such filter and is solved in the linear limit (`invert_contrast`), but for frames in contact
    (all distances 0), which need none. Frames are continued by their edge values; pitch: pixel size [m]; δ must not be
    zero.
    """
    z, energy, d, b = _per_view(distance, energy_kev, delta, beta)
    require(bool(d.all()), "phase retrieval needs a material that differs from its medium in δ, but δ is 0.")
    if (b / d < WEAKEST_ABSORPTION).any() and z.any():
        return invert_contrast(frames - 1, pitch, distance, energy_kev, delta, beta)
    lam_z = wavelength(energy) * z
    padded, crop = _continued(frames, pitch, lam_z, d, b, "replicate")
    f2 = _squared_frequency(padded.shape, pitch)
    low_pass = torch.from_numpy(1 / (1 + np.pi * lam_z * (d / b) * f2))
    contact = torch.fft.irfft2(torch.fft.rfft2(padded) * low_pass, s=padded.shape[-2:])
    mu = torch.from_numpy(2 * wavenumber(energy) * b)
    return (-torch.log(contact.clamp_min(1e-6)) / mu)[crop].to(frames.dtype)


def invert_contrast(
    contrast: Tensor, pitch: float, distance: np.ndarray, energy_kev: PerView, delta: PerView, beta: PerView
) -> Tensor:
    """Thickness (change) [V, H, W] in metres of a single material that explains an intensity change [V, H, W].

    The linear response of a thin object is `F[I - 1] = -H F[T]`, `H = 2k (β cos χ + δ sin χ)`, `χ = πλz f²`
    (Cloetens et al. 1999, eq. 3, for φ and absorption of one material). It is inverted as `H / (H² + α²)` with
    α small up to the first maximum (χ = π/2) and a third of the peak response beyond, where zeros follow.
    Beyond the frame the contrast is taken as zero: a residual continued by its edge values would be blown up.
    energy_kev, delta, beta: of all views, or of each [V].
    """
    z, energy, d, b = _per_view(distance, energy_kev, delta, beta)
    lam_z = wavelength(energy) * z
    padded, crop = _continued(contrast, pitch, lam_z, d, b, "constant")
    chi = np.pi * lam_z * _squared_frequency(padded.shape, pitch)
    k2 = 2 * wavenumber(energy)
    response = k2 * (b * np.cos(chi) + d * np.sin(chi))
    floor = k2 * np.where(chi < 0.5 * np.pi, WEAKEST_ABSORPTION * abs(d), 0.3 * abs(d))
    # Where absorption is feeble, the lowest frequencies say next to nothing, or change their sign.
    feeble = np.maximum(floor, k2 * np.maximum(abs(b), FEEBLE_FLOOR * abs(d)))
    floor = np.where(b / d < WEAKEST_ABSORPTION, feeble, floor)
    inverse = torch.from_numpy(-response / (response**2 + floor**2))
    solved = torch.fft.irfft2(torch.fft.rfft2(padded) * inverse, s=padded.shape[-2:])
    return solved[crop].to(contrast.dtype)


def _per_view(distance: np.ndarray, *values: PerView) -> tuple[np.ndarray, ...]:
    """Distances [V] and numbers of all views or of each, as float64 [V, 1, 1] to go with images."""
    count = np.size(distance)
    arrays = (np.broadcast_to(np.asarray(v, dtype=np.float64).reshape(-1), (count,)) for v in (distance, *values))
    return tuple(np.ascontiguousarray(array)[:, None, None] for array in arrays)


def _continued(
    frames: Tensor, pitch: float, lam_z: np.ndarray, delta: np.ndarray, beta: np.ndarray, mode: str
) -> tuple[Tensor, tuple[slice, slice, slice]]:
    """Frames in float64, continued by twice the filter's length (torch's `mode`), and the slices that undo it.

    lam_z [m²], delta, beta: [V, 1, 1].
    """
    weakest = np.maximum(abs(beta), WEAKEST_ABSORPTION * abs(delta))
    reach = math.sqrt((lam_z * abs(delta) / weakest).max() / math.pi)
    h, w = frames.shape[-2:]
    my, mx = (min(n - 1, math.ceil(2 * reach / pitch)) for n in (h, w))
    padded = pad(frames[None].double(), (mx, mx, my, my), mode=mode)[0]
    return padded, (slice(None), slice(my, my + h), slice(mx, mx + w))


def _squared_frequency(shape: torch.Size, pitch: float) -> np.ndarray:
    """`fx² + fy²` [H, W//2 + 1] in 1/m² (for `rfft2`)."""
    fy, fx = np.fft.fftfreq(shape[-2], pitch), np.fft.rfftfreq(shape[-1], pitch)
    return fy[:, None] ** 2 + fx[None] ** 2
