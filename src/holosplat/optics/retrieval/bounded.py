"""A first estimate for everything iterative: the linear inverse where it is surely not zero, and where matter is.

One frame hardly constrains the lowest frequencies, and the frequencies where the response is zero. Two conditions fill
them in: matter is nowhere negative, and there is none outside its bodies. Of holes in a medium that is said of the
thickness of the holes; of matter on both sides of its medium the second alone.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from ...scan import Exposures
from ..noise import wavelet_noise, with_gaps
from .spectra import (
    TINY,
    Gaps,
    Noise,
    Prior,
    Raster,
    Spectra,
    filtered,
    response,
    spectra,
    squared_frequency,
    surrounded,
    with_power,
)

STEPS = 25
"""Alternations between the frame and the bound. Where noise hides the lowest frequencies they go on to drift."""
LEAVING_STEPS = 100
"""The same of frames that matter leaves: from the sides alone, emptiness takes longer to tell."""
SIGNIFICANT = 2.5
"""Standard deviations of its noise above which a pixel is matter."""
MODEL_ERROR = 0.05
"""Part of a frame's contrast that the wave optics of sampled matter does not explain, measured on cells."""
FIXED = Prior(corner=6.0, decay=1.5)
"""Expected power of a phase where its frame does not show it: the frame's edges cut the matter, so that they make the
lowest frequencies; or it is what a volume lacks, which is flatter than matter. Networks learned with it."""


Leaves = tuple[bool, bool]
"""Whether matter goes on above and below the frames, and at their sides."""
NOWHERE: Leaves = (False, False)


@dataclass(frozen=True)
class Estimate:
    """phase: delay (of holes: advance) [V, H, W] in radians, not negative unless matter is two-sided, float64; support:
    [V, H, W] bool, where there may be matter; lacks: expected mean square [V] of what the phase lacked [rad²] before
    that was asked for, or zero where it was not."""

    phase: Tensor
    support: Tensor
    lacks: Tensor | float


def bounded_estimate(
    frames: Tensor,
    exposures: Exposures,
    ratio: float,
    noise: Noise,
    leaves: Leaves | None = None,
    prior: Prior | None = None,
    sign: float = 1.0,
    *,
    missing: Gaps = None,
    two_sided: bool = False,
    lacking: bool = False,
) -> Estimate:
    """From frames [V, H, W] of a material with β/δ = `ratio` and that `sign` of δ; noise: theirs, None to estimate it.

    Wiener's inverse `W` of the contrast transfer function, in alternation with the bound (Papoulis 1975 and
    Gerchberg 1974, who extend spectra so): `φ ← φ₀ + (1 - W H) [φ]`, where `[φ]` is φ where it exceeds
    `SIGNIFICANT` deviations of its noise and zero elsewhere, for noise with its negative half cut off would pass for
    matter (a support found anew in every round: the "shrinkwrap" of Marchesini et al. 2003). Of that, `W` weighs the
    frames by the power expected of the phase, and then, in as many rounds more, by that of what [φ] lacks: bounds
    determine low frequencies that noise hides better than the frames do. They do not determine matter that the frame's
    edges cut: where it may be, by the share of the strongest phase that is at the edges, the power of all is added.

    Frames of one pose at several distances (`SharedPoses`) have one estimate, by all of them.
    missing: pixels [V, H, W] bool without a value (`completed`). two_sided: whether phases may be negative.
    leaves: whether matter goes on above and below the frame, and at its sides. Air there would take a soft body away
    far into the frame, for only the bends of its shadow are seen; it may then go on, and ends as smoothly as it can.
    None: it is not known whether it does.
    prior: expected power (default: the one that the frames show, or `FIXED` where matter leaves them). lacking: whether
    frames show what a result lacks, such as frames over those of known bodies, so that their power is the one of that.
    """
    contrast, crop = surrounded(frames, exposures)
    raster = Raster((contrast.shape[-2], contrast.shape[-1]), exposures.views.pixel_size)
    unknown, leaves = leaves is None, leaves or NOWHERE
    h, prior = response(exposures, ratio, raster), prior or (FIXED if any(leaves) else None)
    known = spectra(frames, exposures, h, raster, noise, MODEL_ERROR, prior, leaks=prior is None, missing=missing)
    contrast = completed(contrast, missing, crop, known)
    fine = wavelet_noise(with_gaps(frames, missing))
    inside = torch.zeros_like(contrast[:1])
    inside[:, *(slice(None) if on else part for on, part in zip(leaves, crop[1:]))] = 1
    matter = torch.zeros_like(contrast)
    for again in (False, True) if prior is None and not lacking else (False,):
        if again:
            left = (contrast + sign * filtered(matter, h))[crop] + 1
            whole, known = known, with_power(known, left, exposures, raster, noise)
            cut = _cut(matter[crop]) if unknown else torch.zeros(())
            known = replace(known, power=known.power + cut * whole.power, leak=known.leak + cut * whole.leak)
        if noise is None:
            doubtful = known.poses.sum(fine.square() * known.inverse.square().mean(dim=(1, 2))).sqrt()
        else:
            doubtful = known.noise_of(known.inverse)
        least = (SIGNIFICANT * doubtful)[:, None, None]
        linear = -sign * known.poses.sum(filtered(contrast, known.inverse))
        trusted = 1 - known.poses.sum(known.inverse * known.response)
        for _ in range(1 + (LEAVING_STEPS if any(leaves) else STEPS)):
            phase = linear + filtered(matter, trusted)
            matter = phase * ((phase.abs() if two_sided else phase) > least) * inside
    matter = matter[crop]
    grown = max_pool2d((matter != 0).double()[None], 3, 1, 1)[0] > 0  # thin rims lie below the threshold
    seen = squared_frequency(raster) <= (0.5 / raster.pitch) ** 2
    return Estimate(matter, grown, known.power[:, seen].mean(dim=1) if again else 0.0)


def _cut(phase: Tensor) -> Tensor:
    """The greatest phase at a frame's edges over the greatest of all [V, 1, 1], of phases [V, H, W]."""
    sizes = phase.abs()
    edges = torch.cat([sizes[:, 0], sizes[:, -1], sizes[:, :, 0], sizes[:, :, -1]], dim=1)
    return (edges.amax(dim=1) / sizes.amax(dim=(1, 2)).clamp_min(TINY))[:, None, None]


FILLINGS = 50
"""Steps of conjugate gradients in which missing pixels take what the others say of them."""


def completed(contrast: Tensor, missing: Gaps, crop: tuple[slice, slice, slice], known: Spectra) -> Tensor:
    """The contrast [V, H, W] with missing pixels as the likeliest phase of the others predicts them.

    missing: of the frame, which `crop` takes out of the contrast. With K = H W, the response after Wiener's inverse,
    the values x in the gaps solve `x = P K (c + x)`, P being their projection: expectation and maximisation in one
    (Dempster et al. 1977). So the pixels have no weight.
    """
    if missing is None or not missing.any():
        return contrast
    gain, gaps = known.own_inverse * known.response, torch.zeros_like(contrast)
    gaps[crop] = missing.to(gaps)

    def explained(images: Tensor) -> Tensor:
        return gaps * filtered(images, gain)

    def squared(images: Tensor) -> Tensor:
        return images.square().sum(dim=(1, 2), keepdim=True)

    c = contrast * (1 - gaps)
    x, left = torch.zeros_like(c), explained(c)
    way, size = left, squared(left)
    for _ in range(FILLINGS):
        slope = way - explained(way)
        length = size / (way * slope).sum(dim=(1, 2), keepdim=True).clamp_min(TINY)
        x, left = x + length * way, left - length * slope
        size, before = squared(left), size
        way = left + size / before.clamp_min(TINY) * way
    return c + x
