"""Absorption alone: frames taken in contact, or so close behind the matter that no fringe is seen.

Behind matter of thickness T the intensity is then `exp(-2 k β T)` (docs/conventions.md), and nothing in it depends on
δ. What every method of retrieval returns there is the logarithm, with no prior: tomography weighs the noise.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import wraps
from typing import Any, TypeVar, cast

import numpy as np
import scipy.ndimage as ndimage
import torch
from torch import Tensor

from ...checks import require
from ...scan import Exposures
from ...units import wavenumber
from ..noise import noise_levels, with_gaps
from ..sampling import SharedPoses
from .spectra import checked, column, finest_phase

UNSEEN = 0.01
"""Refraction that changes the contrast of the finest detail by less than this share of its absorption is not seen."""
LEAST_INTENSITY = 1e-6
"""Intensity taken for the darkest pixel's, where frames have no noise that would set it."""


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


def or_in_contact(method: Method) -> Method:
    """`method` for the views that show refraction, and `contact_thickness` for those that show absorption alone."""

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
