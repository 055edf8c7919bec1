"""Retrieval of single frames through the full wave optics: the smoothest non-negative thickness (Tikhonov), and total
variation (ADMM)."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from ...progress import Advance
from ...ranges import Weight, checked_dataclass
from ...scan import Exposures
from .contact import or_in_contact
from .model import Regularised, WaveModel, WaveOptions, view_by_view
from .spectra import TINY, squared_frequency

FIRST_DAMPING = 0.05
"""Damping at the start; 1 is the curvature of the strongest frequency."""
EASE, TIGHTEN = 0.6, 4.0
"""Factors of the damping after an accepted and after a refused step."""
STIFFEST = 1.0
"""Bound of the penalty, in the same unit, for frequencies with hardly any expected power."""


@checked_dataclass
class Tikhonov(Regularised):
    """Options of the fit with a quadratic penalty; its iterations are accepted or refused steps."""

    weight: Weight = 0.5
    """Weight of the penalty; 1 is the Bayesian weight for Gaussian matter."""


@checked_dataclass
class ADMM(Regularised):
    """Options. iterations: updates of the multipliers; weight: of total variation, relative to the mean slope of the
    estimate."""


Options = TypeVar("Options", bound=WaveOptions)


def through_waves(usual: Options) -> Callable[[Callable[[Options, WaveModel, Advance], Tensor]], Callable[..., Tensor]]:
    """Make a `Retrieval`, whose `options` are by default as `usual`, of a function that finds the bounded phases
    [V, H, W] of views that are alike, by options, model and progress."""

    def made(solve: Callable[[Options, WaveModel, Advance], Tensor]) -> Callable[..., Tensor]:
        def method(
            frames: Tensor,
            exposures: Exposures,
            delta: float,
            beta: float,
            *,
            options: Options = usual,
            missing: Tensor | None = None,
            two_sided: bool = False,
            on_progress: Advance = lambda fraction: None,
        ) -> Tensor:
            told = (missing, two_sided, on_progress)
            return view_by_view(frames, exposures, (delta, beta), options, partial(solve, options), told)

        method.__name__ = method.__qualname__ = solve.__name__
        method.__doc__ = solve.__doc__
        return or_in_contact(method)

    return made


@through_waves(Tikhonov())
def tikhonov(options: Tikhonov, model: WaveModel, on_progress: Advance) -> Tensor:
    """Thickness [V, H, W] in metres of one material, β of any sign, that agrees with frames [V, H, W].

    It minimises `½ Σ (√I(φ) - √I)² + ½ Σ R |F[φ]|²` over phases φ = k|δ|T that are not negative (unless `two_sided`)
    and lie within a support, as Huhn et al. (2022) do, with three differences. R is the noise over the expected power
    (`Spectra`), instead of one constant below and another above the first maximum. Steps are scaled by frequency and
    damped as by Levenberg (1944) and Marquardt (1963), so that the lowest frequencies, whose signal is a millionth of
    the others', change too. The iteration starts from `bounded_estimate` and keeps its support. A step that would not
    lower the objective is refused, and its view is damped more.
    """
    return descend(model, options, on_progress)[0]


def penalty_weights(model: WaveModel, weight: float) -> Tensor:
    """R [V, H, W//2 + 1]: variance of the roots over the expected power, in the unit of the misfit's curvature.

    The power has the shape of the prior and the total power of the estimate and of what it lacks: the mean of a square
    is that of the mean and its variance. A power that only explains a frame's contrast would be too small at the lowest
    frequencies of compact matter, and the penalty would shrink the matter.
    """
    known = model.spectra
    seen = squared_frequency(model.raster) <= (0.5 / model.exposures.views.pixel_size) ** 2
    found = torch.fft.rfft2(model.phase.cpu().double()).abs().square() / math.prod(model.raster.shape)
    inside = math.prod(model.exposures.views.shape) * model.oversample**2 / math.prod(model.raster.shape)
    expected = found[:, seen].mean(dim=1) / model.oversample**2 + inside * model.lacks
    scale = expected / known.power[:, seen].mean(dim=1)
    variance = 0.25 * known.poses.mean(known.unexplained) / scale.clamp_min(TINY)[:, None, None]
    stiffness = (weight * variance / known.power).minimum(STIFFEST * model.strongest)
    return stiffness / model.oversample**2


def objective(model: WaveModel, phase: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Misfit and penalty together [V], float64, and their gradient [V, H, W] on the waves' raster."""
    value, gradient = model.misfit(phase)
    pull = model.filter(phase, weights)
    return value + 0.5 * (phase.double() * pull).sum(dim=(1, 2)), gradient + pull


def descend(model: WaveModel, options: Tikhonov, on_progress: Advance) -> tuple[Tensor, Tensor]:
    """The phase [V, H, W] after all steps, and the objective [iterations + 1, V] before and after each."""
    weights = penalty_weights(model, options.weight)
    curvature = model.curvature() + weights
    phase = model.phase
    value, gradient = objective(model, phase, weights)
    damping = FIRST_DAMPING * model.strongest.flatten().to(value.dtype)
    values = [value]
    for done in range(options.iterations):
        on_progress(done / options.iterations)
        scale = 1 / (curvature + damping[:, None, None] / model.oversample**2)
        trial = model.bounded(phase - model.filter(gradient, scale))
        trial_value, trial_gradient = objective(model, trial, weights)
        better = trial_value < value
        phase, gradient = (
            torch.where(better[:, None, None], new, old) for new, old in ((trial, phase), (trial_gradient, gradient))
        )
        value = torch.where(better, trial_value, value)
        damping = damping * torch.where(better.cpu(), EASE, TIGHTEN)
        values.append(value)
    return phase, torch.stack(values)


EDGE = 0.5
"""Jumps of phase that are taken for edges within one iteration, in mean slopes of the matter."""
COUPLING = 0.05
"""Penalty of leaving the bounds, in the curvature of the strongest frequency."""


@through_waves(ADMM())
def admm(options: ADMM, model: WaveModel, on_progress: Advance) -> Tensor:
    """Thickness [V, H, W] in metres of one material, β of any sign, with edges: frames [V, H, W] through full waves.

    `½ Σ (√I(φ) - √I)² + w TV(φ)` over phases φ = k|δ|T that are not negative (unless `two_sided`) and lie within a
    support, split as by Goldstein & Osher (2009): slopes d = ∇φ are shrunk, a copy z = φ is bounded, and φ takes one
    damped Newton step, which is diagonal in Fourier space. Wen et al. (2012) split at the detector instead, where the
    amplitude has an exact proximal map; but point-spread function and pixel stand between wave and amplitude there, and
    the phase of a wave of its own may wrap. Villanueva-Perez et al. (2017) split the linear model; this is theirs, with
    the wave optics in its place and total variation beside the bounds.
    """
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
