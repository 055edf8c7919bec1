"""Total variation with the full wave optics, by the alternating direction method of multipliers."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from ...progress import Advance
from ...ranges import checked_dataclass
from ...scan import Exposures
from .contact import or_in_contact
from .model import Regularised, WaveModel, view_by_view
from .nonlinear import EASE, FIRST_DAMPING, TIGHTEN
from .spectra import Gaps, Noise

EDGE = 0.5
"""Jumps of phase that are taken for edges within one iteration, in mean slopes of the matter."""
COUPLING = 0.05
"""Penalty of leaving the bounds, in the curvature of the strongest frequency."""


@checked_dataclass
class ADMM(Regularised):
    """Options. iterations: updates of the multipliers; weight: of total variation, relative to the mean slope of the
    estimate."""


@or_in_contact
def admm(
    frames: Tensor,
    exposures: Exposures,
    delta: float,
    beta: float,
    *,
    options: ADMM = ADMM(),
    missing: Tensor | None = None,
    two_sided: bool = False,
    on_progress: Advance = lambda fraction: None,
) -> Tensor:
    """Thickness [V, H, W] in metres of one material, β of any sign, with edges: frames [V, H, W] through full waves.

    `½ Σ (√I(φ) - √I)² + w TV(φ)` over phases φ = k|δ|T that are not negative (unless `two_sided`) and lie within a
    support, split as by Goldstein & Osher (2009): slopes d = ∇φ are shrunk, a copy z = φ is bounded, and φ takes one
    damped Newton step, which is diagonal in Fourier space. Wen et al. (2012) split at the detector instead, where the
    amplitude has an exact proximal map; but point-spread function and pixel stand between wave and amplitude there, and
    the phase of a wave of its own may wrap. Villanueva-Perez et al. (2017) split the linear model; this is theirs, with
    the wave optics in its place and total variation beside the bounds.
    """

    def solve(frames: Tensor, exposures: Exposures, noise: Noise, missing: Gaps, on_progress: Advance) -> Tensor:
        how = (options.backend, options.leaves, options.prior)
        told = {"sign": math.copysign(1.0, delta), "missing": missing, "two_sided": two_sided}
        model = WaveModel(frames, exposures, beta / delta, noise, *how, **told)
        return model.thickness(_alternate(model, options, on_progress), delta)

    return view_by_view(frames, exposures, delta, (options.noise, missing), solve, on_progress)


def _alternate(model: WaveModel, options: ADMM, on_progress: Advance) -> Tensor:
    """The bounded phase [V, H, W] after all iterations."""
    phase = model.phase
    weight, edge = _weights(model, options)
    pull_slopes, pull_copy = weight / edge, COUPLING * model.strongest / model.oversample**2
    like = {"device": phase.device, "dtype": phase.dtype}
    pull, shrink, hold = pull_slopes.to(**like), edge.to(**like), pull_copy.to(**like)
    curvature = model.curvature() + pull_slopes * _laplacian(model.raster.shape) + pull_copy
    slopes, copy = gradient(phase), phase.clone()
    slopes_dual, copy_dual = torch.zeros_like(slopes), torch.zeros_like(phase)
    misfit, fall = model.misfit(phase)
    damping = FIRST_DAMPING * model.strongest.flatten().to(misfit.dtype)

    def coupled(at: Tensor) -> Tensor:
        """The terms of the constraints in the objective [V]."""
        away = (gradient(at) - slopes + slopes_dual).double().square().sum(dim=(0, 2, 3))
        apart = (at - copy + copy_dual).double().square().sum(dim=(1, 2))
        return 0.5 * (pull[:, 0, 0] * away + hold[:, 0, 0] * apart)

    for done in range(options.iterations):
        on_progress(done / options.iterations)
        slant = fall + pull * gradient_adjoint(gradient(phase) - slopes + slopes_dual)
        slant = slant + hold * (phase - copy + copy_dual)
        scale = 1 / (curvature + damping[:, None, None] / model.oversample**2)
        trial = phase - model.filter(slant, scale)
        trial_misfit, trial_fall = model.misfit(trial)
        better = trial_misfit + coupled(trial) <= misfit + coupled(phase)
        chosen = better[:, None, None]
        phase, fall = torch.where(chosen, trial, phase), torch.where(chosen, trial_fall, fall)
        misfit = torch.where(better, trial_misfit, misfit)
        damping = damping * torch.where(better.cpu(), EASE, TIGHTEN)
        # The multipliers of a view whose step was refused wait for it.
        total = gradient(phase) + slopes_dual
        length = total.square().sum(dim=0).sqrt()
        shrunk = total * (1 - shrink / length.clamp_min(1e-30)).clamp_min(0)
        slopes, slopes_dual = torch.where(chosen, shrunk, slopes), torch.where(chosen, total - shrunk, slopes_dual)
        total = phase + copy_dual
        bounded = model.bounded(total)
        copy, copy_dual = torch.where(chosen, bounded, copy), torch.where(chosen, total - bounded, copy_dual)
    return copy


def _weights(model: WaveModel, options: ADMM) -> tuple[Tensor, Tensor]:
    """Weight of total variation and the slope [rad] that is shrunk away, both [V, 1, 1], float64.

    A Laplacian prior of mean slope b weighs `σ²/4b` against roots of variance σ²/4.
    """
    slope = gradient(model.phase).square().sum(dim=0).sqrt().double().sum(dim=(1, 2))
    mean = (slope / model.support.double().sum(dim=(1, 2)).clamp_min(1)).cpu().clamp_min(1e-9)
    unexplained = model.spectra.poses.mean(model.spectra.unexplained.mean(dim=(1, 2)))
    weight = options.weight * 0.25 * unexplained / mean / model.oversample**2
    return weight.clamp_min(1e-12)[:, None, None], (EDGE * mean)[:, None, None]


def gradient(images: Tensor) -> Tensor:
    """Differences [2, V, H, W] to the next row and the next column of [V, H, W], periodic."""
    return torch.stack((images.roll(-1, 1) - images, images.roll(-1, 2) - images))


def gradient_adjoint(slopes: Tensor) -> Tensor:
    """Adjoint of `gradient`: [2, V, H, W] → [V, H, W]."""
    rows, columns = slopes
    return rows.roll(1, 1) - rows + columns.roll(1, 2) - columns


def _laplacian(shape: tuple[int, int]) -> Tensor:
    """Eigenvalues [H, W//2 + 1] of `gradient_adjoint(gradient(·))`."""
    rows, columns = (
        torch.from_numpy(2 - 2 * np.cos(2 * np.pi * f)) for f in (np.fft.fftfreq(shape[0]), np.fft.rfftfreq(shape[1]))
    )
    return rows[:, None] + columns
