"""Nonlinear Tikhonov: the smoothest non-negative thickness that explains a frame through the full wave optics."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ...progress import Advance
from ...ranges import Weight, checked_dataclass
from ...scan import Exposures
from .contact import or_in_contact
from .model import Regularised, WaveModel, view_by_view
from .spectra import TINY, Gaps, Noise, squared_frequency

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


@or_in_contact
def tikhonov(
    frames: Tensor,
    exposures: Exposures,
    delta: float,
    beta: float,
    *,
    options: Tikhonov = Tikhonov(),
    missing: Tensor | None = None,
    two_sided: bool = False,
    on_progress: Advance = lambda fraction: None,
) -> Tensor:
    """Thickness [V, H, W] in metres of one material, β of any sign, that agrees with frames [V, H, W].

    It minimises `½ Σ (√I(φ) - √I)² + ½ Σ R |F[φ]|²` over phases φ = k|δ|T that are not negative (unless `two_sided`)
    and lie within a support, as Huhn et al. (2022) do, with three differences. R is the noise over the expected power
    (`Spectra`), instead of one constant below and another above the first maximum. Steps are scaled by frequency and
    damped as by Levenberg (1944) and Marquardt (1963), so that the lowest frequencies, whose signal is a millionth of
    the others', change too. The iteration starts from `bounded_estimate` and keeps its support. A step that would not
    lower the objective is refused, and its view is damped more.
    """

    def solve(frames: Tensor, exposures: Exposures, noise: Noise, missing: Gaps, on_progress: Advance) -> Tensor:
        how = (options.backend, options.leaves, options.prior)
        told = {"sign": math.copysign(1.0, delta), "missing": missing, "two_sided": two_sided}
        model = WaveModel(frames, exposures, beta / delta, noise, *how, **told)
        return model.thickness(descend(model, options, on_progress)[0], delta)

    return view_by_view(frames, exposures, delta, (options.noise, missing), solve, on_progress)


def penalty_weights(model: WaveModel, weight: float) -> Tensor:
    """R [V, H, W//2 + 1]: variance of the roots over the expected power, in the unit of the misfit's curvature.

    The power has the shape of the prior and the total power of the estimate. A power that only explains a frame's
    contrast would be too small at the lowest frequencies of compact matter, and the penalty would shrink the matter.
    """
    known = model.spectra
    seen = squared_frequency(model.raster) <= (0.5 / model.exposures.views.pixel_size) ** 2
    found = torch.fft.rfft2(model.phase.cpu().double()).abs().square() / math.prod(model.raster.shape)
    scale = found[:, seen].mean(dim=1) / model.oversample**2 / known.power[:, seen].mean(dim=1)
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
