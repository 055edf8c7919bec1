"""Phase retrieval in one step: by a filter, Paganin's and the contrast transfer function of one material; or by
absorption alone, of frames taken in contact, or so close behind the matter that no fringe is seen.

Behind matter of thickness T the intensity is then `exp(-2 k β T)` (docs/conventions.md), and nothing in it depends on
δ. What every method of retrieval returns there is the logarithm, with no prior: tomography weighs the noise.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial, wraps
from typing import Any, TypeVar, cast

import numpy as np
import scipy.ndimage as ndimage
import torch
from torch import Tensor
from torch.nn.functional import interpolate, pad

from ...checks import require
from ...progress import Advance
from ...ranges import checked_dataclass
from ...scan import Exposures
from ...units import wavelength, wavenumber
from ..hologram import hologram, optical_path
from ..noise import noise_levels, with_gaps
from ..sampling import SharedPoses, alike, fringe_sampling, padding
from .bounded import completed
from .spectra import (
    Noise,
    Prior,
    Raster,
    absorption,
    check_noise,
    checked,
    column,
    detector_transfer,
    filtered,
    finest_phase,
    fresnel_phase,
    radian,
    response,
    spectra,
    surrounded,
)

UNSEEN = 0.01
"""Refraction that changes the contrast of the finest detail by less than this share of its absorption is not seen."""
LEAST_INTENSITY = 1e-6
"""Intensity taken for the darkest pixel's, where frames have no noise that would set it."""
FINEST = 4
"""Times the samples of fits by which the frames of steep walls are known."""
DARKEST = 1e-3
"""Least intensity behind a wall that frames are divided by."""


def _apart_px(exposures: Exposures, poses: SharedPoses) -> np.ndarray:
    """How far each frame [V] lies beside the first one of its projection along rows and columns [pixels]."""
    shifts = exposures.views.shifts[:, ::-1] / exposures.views.pixel_size
    _, first = np.unique(poses.of, return_index=True)
    apart = shifts - shifts[first[poses.of]]
    return np.where(np.abs(apart) > np.finfo(np.float32).eps * max(exposures.views.shape), apart, 0.0)


def _moved(images: Tensor, pixels: np.ndarray, beyond: float | None = None) -> Tensor:
    """Images [V, H, W] on rasters that lie `pixels` [V, 2] further along rows and columns, by cubic splines; beyond:
    the value outside (default: that of the edge)."""
    found = images.clone()
    mode, value = ("nearest", 0.0) if beyond is None else ("constant", beyond)
    for n in np.flatnonzero(pixels.any(axis=1)):
        order = 3 if beyond is None else 1
        image = ndimage.shift(images[n].double().cpu().numpy(), -pixels[n], order=order, mode=mode, cval=value)
        found[n] = torch.from_numpy(image).to(images)
    return found


Method = TypeVar("Method", bound=Callable[..., Tensor])


def absorption_alone(exposures: Exposures, ratio: float) -> np.ndarray:
    """[V] bool: views in which refraction is not seen beside absorption, for matter with β/δ = `ratio`.

    A thin object's response is `2 (β/δ cos χ + sin χ)` (`spectra`): without fringes where χ stays far below |β|/δ.
    """
    delta, beta = exposures.refraction(1.0, ratio)
    return finest_phase(exposures) <= UNSEEN * np.abs(beta) / delta


def contact_thickness(
    frames: Tensor, exposures: Exposures, delta: float, beta: float, missing: Tensor | None = None
) -> Tensor:
    """Thickness [V, H, W] in metres, `-ln I / 2kβ`, of matter with β ≠ 0 from frames [V, H, W] of absorption alone.

    Errors: `InputError` for matter that does not absorb.
    """
    require(
        beta != 0,
        "frames in contact (distance 0) show absorption alone, but the material has β = 0; give one that absorbs, or "
        "frames taken at a distance.",
    )
    mu = column(2 * wavenumber(exposures.energy_kev) * exposures.refraction(delta, beta)[1])
    one_photon = noise_levels(with_gaps(frames, missing))[
        :, None, None
    ].square()  # variance σ² of relative frames: a photon counts σ²
    least = one_photon.clamp_min(LEAST_INTENSITY).to(frames.device)
    return (-torch.log(torch.maximum(frames.double(), least)) / mu.to(frames.device)).to(frames.dtype)


ROUNDS = 3
"""How often the frames beside a wall are made anew for a retrieval: first with no matter, then with what was found."""


def seen(exposures: Exposures, thickness: Tensor, material: tuple[float, float], s: int) -> Tensor:
    """Frames [V, H, W] of a thickness [V, H, W] [m] of `material` (δ, β), which goes on beyond as at the edge, and of
    the wall of the exposures, if any; s: wave samples along a pixel's edge."""
    found = torch.empty_like(thickness)
    for index in alike(exposures, s):
        part = exposures[index]
        (my, mx), optical = padding(part, s), part.optical
        wide = pad(thickness[index][:, None], (mx, mx, my, my), mode="replicate")
        fine = interpolate(wide, scale_factor=s, mode="bilinear", align_corners=False)[:, 0]
        units = [wavenumber(part.energy_kev) * share for share in part.refraction(1.0, 1.0)[::-1]]
        lines = [fine * material[1], fine * material[0]]
        if part.wall is not None:
            known = part.wall.behind(part.views.padded((my, mx)).refined(s), *units)
            lines = [mine + other.to(fine) for mine, other in zip(lines, known)]
        B, D = (line * column(unit).to(fine) for line, unit in zip(lines, units))
        frame = (part.views.shape, (my * s, mx * s), s)
        blurs, pitch = optical.psf_sigma_px * s, optical.views.pitch / s
        path = optical_path(
            (fine.shape[1], fine.shape[2]), pitch, part.energy_kev, optical.distance, blurs, frame, fine.dtype
        )
        found[index] = hologram(torch.stack((D, B), 1), [(1.0, 0.0), (0.0, 1.0)], path, "reference")
    return found


def beside_faces(exposures: Exposures, few: Tensor) -> Tensor:
    """What frames `few` [V, H, W] of a wall alone lack, [V, H, W]: those of `FINEST` times finer samples less them.

    At flat faces along the beam waves have no end of high frequencies, and samples that hold those of what is inside
    lack them; what they miss of the wall's own frame is the most of it.
    """
    views = exposures.views
    rows = 1 if views.shares_axis else views.shape[0]
    exposures = replace(exposures, views=replace(views, shape=(rows, views.shape[1])))
    nothing = few.new_zeros((len(views), rows, views.shape[1]), device="cpu")
    return seen(exposures, nothing, (1.0, 0.0), FINEST * fringe_sampling(exposures)).to(few) - few


def without_wall(
    method: Callable[[Tensor, Exposures], Tensor], frames: Tensor, exposures: Exposures, material: tuple[float, float]
) -> Tensor:
    """What `method` retrieves of `material` (δ, β) from frames [V, H, W] beside a known wall (`Exposures.wall`).

    It is given the frames times `I(T) / I(T + wall)`, T being the thickness that it found before, so that all that the
    model does not explain stays in them. With no matter they are the frames over those of the wall.
    """
    alone = replace(exposures, wall=None)
    found, s = torch.zeros_like(frames), fringe_sampling(exposures)
    more = beside_faces(exposures, seen(exposures, found.cpu(), material, s)).to(frames)
    for _ in range(ROUNDS):
        without, within = (seen(which, found.cpu(), material, s).to(frames) for which in (alone, exposures))
        found = method(frames * without / (within + more).clamp_min(DARKEST), alone)
    return found


def or_in_contact(method: Method) -> Method:
    """`method` for the views that show refraction, and `contact_thickness` for those that show absorption alone; beside
    a wall that is known, for frames as if without it (`without_wall`)."""

    @wraps(method)
    def retrieve(
        frames: Tensor,
        exposures: Exposures,
        delta: float,
        beta: float,
        *,
        missing: Tensor | None = None,
        **options: Any,
    ) -> Tensor:
        if exposures.wall is not None:
            alone = partial(retrieve, delta=delta, beta=beta, missing=missing, **options)
            return without_wall(alone, frames, exposures, (delta, beta))
        exposures = exposures.optical
        checked(frames, exposures, delta)
        poses = SharedPoses(exposures)
        alone = absorption_alone(exposures, beta / delta)
        if poses.any:  # beside frames at a distance, those in contact have their part in the waves
            alone = poses.mean(torch.from_numpy(alone).double()).numpy() == 1
        apart = _apart_px(exposures, poses)
        if apart.any():
            gaps = torch.zeros(frames.shape, dtype=torch.bool) if missing is None else missing
            frames, missing = _moved(frames, -apart), _moved(gaps.double(), -apart, beyond=1.0) > 0
            views = replace(
                exposures.views, shifts=exposures.views.shifts - apart[:, ::-1] * exposures.views.pixel_size
            )
            there = retrieve(frames, replace(exposures, views=views), delta, beta, missing=missing, **options)
            return _moved(there, apart)
        if not alone.any():
            return method(frames, exposures, delta, beta, missing=missing, **options)
        found = torch.empty_like(frames)
        found[alone] = contact_thickness(
            frames[alone], exposures[alone], delta, beta, missing if missing is None else missing[alone]
        )
        if not alone.all():
            some = None if missing is None else missing[~alone]
            found[~alone] = method(frames[~alone], exposures[~alone], delta, beta, missing=some, **options)
        return found

    return cast(Method, retrieve)


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

    def __post_init__(self) -> None:
        check_noise(self.noise)


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
