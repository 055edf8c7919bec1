"""Absorption alone: frames taken in contact, or so close behind the matter that no fringe is seen.

Behind matter of thickness T the intensity is then `exp(-2 k β T)` (docs/conventions.md), and nothing in it depends on
δ. What every method of retrieval returns there is the logarithm, with no prior: tomography weighs the noise.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial, wraps
from inspect import signature
from itertools import product
from typing import Any, TypeVar, cast

import numpy as np
import scipy.ndimage as ndimage
import torch
from torch import Tensor
from torch.nn.functional import interpolate, pad

from ...checks import require
from ...scan import Exposures
from ...units import wavenumber
from ..hologram import hologram, optical_path
from ..noise import noise_levels, with_gaps
from ..sampling import SharedPoses, alike, fringe_sampling, padding
from .spectra import checked, column, finest_phase, part_of

UNSEEN = 0.01
"""Refraction that changes the contrast of the finest detail by less than this share of its absorption is not seen."""
LEAST_INTENSITY = 1e-6
"""Intensity taken for the darkest pixel's, where frames have no noise that would set it."""
FINEST, FINEST_ROW = 4, 16
"""Times the samples of fits by which the frames of steep walls are known; and where all rows are alike, so that one
tells them."""
DARKEST = 1e-3
"""Least intensity behind a wall that frames are divided by."""


def _apart_px(exposures: Exposures, poses: SharedPoses) -> np.ndarray:
    """How far each frame [V] lies beside the first one of its projection along rows and columns [pixels]."""
    shifts = exposures.views.shifts[:, ::-1] / exposures.views.pixel_size
    _, first = np.unique(poses.of, return_index=True)
    apart = shifts - shifts[first[poses.of]]
    return np.where(np.abs(apart) > np.finfo(np.float32).eps * max(exposures.views.shape), apart, 0.0)


def _moved(images: Tensor, pixels: np.ndarray, beyond: float | None = None, ratios: np.ndarray | None = None) -> Tensor:
    """Images [V, H, W] on rasters that lie `pixels` [V, 2] of theirs further along rows and columns, by cubic splines,
    and whose pixels are `ratios` [V] ≥ 1 times as large; beyond: the value outside (default: that of the edge).

    A larger pixel is the mean of evenly spaced samples by which the variance of their places grows as by its width,
    from s²/12 to (ratio s)²/12: for whole ratios, of the pixels within it.
    """
    found = images.clone()
    ratios = np.ones(len(images)) if ratios is None else ratios
    order, mode, value = (3, "nearest", 0.0) if beyond is None else (1, "constant", beyond)
    for n in np.flatnonzero(pixels.any(axis=1) | (ratios != 1)):
        image, ratio = images[n].double().cpu().numpy(), float(ratios[n])
        count = math.ceil(ratio)
        around = math.sqrt((ratio**2 - 1) / max(count**2 - 1, 1)) * (np.arange(count) - 0.5 * (count - 1))
        first = pixels[n] + 0.5 * (1 - ratio) * (np.array(image.shape) - 1)
        samples = (
            ndimage.affine_transform(image, [ratio, ratio], first + at, order=order, mode=mode, cval=value)
            for at in product(around, around)
        )
        found[n] = torch.from_numpy(sum(samples) / count**2).to(images)
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
        my = 0 if thickness.shape[1] == 1 else my  # what goes on as at the edge has no edge along one row
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
    """What frames `few` [V, H, W] of a wall alone lack, [V, H, W]: those of `FINEST` times finer samples, or of one row
    of `FINEST_ROW` times finer ones, less them.

    At flat faces along the beam waves have no end of high frequencies, and samples that hold those of what is inside
    lack them; what they miss of the wall's own frame is the most of it.
    """
    views = exposures.views
    rows = 1 if views.shares_axis else views.shape[0]
    exposures = replace(exposures, views=replace(views, shape=(rows, views.shape[1])))
    nothing = few.new_zeros((len(views), rows, views.shape[1]), device="cpu")
    finer = (FINEST_ROW if rows == 1 else FINEST) * fringe_sampling(exposures)
    return seen(exposures, nothing, (1.0, 0.0), finer).to(few) - few


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


def _bands(missing: Tensor | None, rows: int) -> np.ndarray:
    """First row and the one after the last [V, 2] of those of each frame that have a pixel with a value; of a frame
    without any, all."""
    if missing is None:
        return np.array([[0, rows]])
    known = (~missing).any(2).cpu().numpy()
    bands = np.stack([known.argmax(1), rows - known[:, ::-1].argmax(1)], 1)
    return np.where(known.any(1, keepdims=True), bands, [0, rows])


def _in_bands(
    method: Callable[..., Tensor], frames: Tensor, exposures: Exposures, missing: Tensor, bands: np.ndarray
) -> Tensor:
    """What `method` retrieves of frames as large as their `bands` of rows, beyond which it is as in the outermost ones.

    Rows without any value say nothing, so that such a frame is a smaller one (`io.larger_frames.heightened`).
    """
    found, counts = torch.empty_like(frames), bands[:, 1] - bands[:, 0]
    for count in np.unique(counts):
        some = np.flatnonzero(counts == count)
        rows = torch.from_numpy(bands[some, 0][:, None] + np.arange(count)).to(frames.device)
        at = torch.from_numpy(some).to(frames.device)[:, None]
        part, (h, w) = exposures[some], frames.shape[1:]
        part = replace(part, views=replace(part.views, shape=(int(count), w)))  # where they lie plays no part
        gaps = missing[at, rows]
        band = method(frames[at, rows], part, missing=gaps if gaps.any() else None)
        nearest = (torch.arange(h, device=frames.device) - rows[:, :1]).clamp(0, int(count) - 1)
        found[at[:, 0]] = band[torch.arange(len(some), device=frames.device)[:, None], nearest]
    return found


def _on_each_raster(
    method: Callable[..., Tensor], frames: Tensor, exposures: Exposures, missing: Tensor | None, options: Any
) -> Tensor:
    """What `method` retrieves of frames [V, H, W] whose pixels differ: of those of each size on their own raster, with
    the frames of their poses that have smaller pixels brought there, at the distances that these have.

    Larger pixels do not tell what smaller ones resolve, so that those have no part in them.
    """
    views, sizes = exposures.views, exposures.views.pixel_sizes
    of = SharedPoses(replace(exposures, views=replace(views, scales=None))).of
    gaps = torch.zeros(frames.shape, dtype=torch.bool) if missing is None else missing
    found = torch.empty_like(frames)
    for size in np.unique(sizes):
        own = sizes == size
        which = np.concatenate((np.flatnonzero(own), np.flatnonzero((sizes < size) & np.isin(of, of[own]))))
        ratios, part = size / sizes[which], exposures[which]
        shifts = views.shifts[[v if own[v] else np.flatnonzero(own & (of == of[v]))[0] for v in which]]
        apart = (shifts - views.shifts[which])[:, ::-1] / sizes[which, None]
        unseen = _moved(gaps[which].double(), apart, 1.0, ratios) > 0
        there = replace(part.views, pitch=float(size), scales=None, shifts=shifts)
        told = replace(options, noise=part_of(options.noise, which))
        lines = method(
            _moved(frames[which], apart, ratios=ratios),
            replace(part, views=there, psf_sigma_px=part.psf_sigma_px / ratios),
            missing=unseen if unseen.any() else None,
            options=told,
        )
        found[own] = lines[: own.sum()]
    return found


def or_in_contact(method: Method) -> Method:
    """`method` for the views that show refraction, and `contact_thickness` for those that show absorption alone; beside
    a wall that is known, for frames as if without it (`without_wall`)."""

    usual = signature(method).parameters["options"].default

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
        checked(frames, exposures, delta)
        flat = replace(exposures, views=replace(exposures.views, scales=None))
        if not exposures.views.has_one_pixel and (SharedPoses(flat).any or SharedPoses(exposures.optical).any):
            how = {"options": usual} | options
            one = partial(retrieve, delta=delta, beta=beta, **{name: how[name] for name in how if name != "options"})
            return _on_each_raster(one, frames, exposures, missing, how["options"])
        exposures = exposures.optical
        poses, bands = SharedPoses(exposures), _bands(missing, frames.shape[1])
        if missing is not None and not poses.any and (bands[:, 1] - bands[:, 0] < frames.shape[1]).any():
            return _in_bands(partial(retrieve, delta=delta, beta=beta, **options), frames, exposures, missing, bands)
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
