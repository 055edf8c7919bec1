"""Retrieval of single frames by alternating projections (Gerchberg–Saxton and Fienup)."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn.functional import pad

from holosplat.optics.propagation import exit_wave_of
from holosplat.optics.retrieval.model import DARKEST, WaveModel, WaveOptions
from holosplat.optics.retrieval.nonlinear import through_waves
from holosplat.progress import Advance
from holosplat.ranges import Natural, checked_dataclass


@checked_dataclass
class Projections(WaveOptions):
    """Options of the alternating projections."""

    iterations: Natural = 40
    """Pairs of projections."""
    feedback: float = 0.9
    """Factor of the values that violate the bounds, for hybrid input–output only (Fienup 1982)."""


@through_waves(Projections())
def gerchberg_saxton(options: Projections, model: WaveModel, on_progress: Advance) -> Tensor:
    """Thickness [V, H, W] in metres of one material, β of any sign, by alternating projections.

    Gerchberg & Saxton (1972), or Fienup's (1982) error reduction: the wave in the detector plane takes the measured
    amplitude, the wave behind the object becomes `exp(-(kβ + ikδ) T)` with T ≥ 0 (unless `two_sided`), zero outside the
    support of `bounded_estimate`, from which it starts. Frequencies around the zeros of the response stay as they were.
    """

    def reduce(_: Tensor, projected: Tensor) -> Tensor:
        return model.bounded(projected)

    return _alternate(options, reduce, model, on_progress)


@through_waves(Projections())
def hybrid_input_output(options: Projections, model: WaveModel, on_progress: Advance) -> Tensor:
    """Thickness [V, H, W] in metres of one material, β of any sign, by Fienup's (1982) hybrid input–output.

    As `gerchberg_saxton`, but where the phase φ' after the detector's projection is negative (unless `two_sided`) or
    outside the support, the next input is `φ - 0.9 φ'`: pushed away from the violation, not set to zero. The last
    iterate is bounded.
    """

    def push(before: Tensor, projected: Tensor) -> Tensor:
        allowed = (projected >= model.least) & (model.support > 0)
        return torch.where(allowed, projected, before - options.feedback * projected)

    return _alternate(options, push, model, on_progress)


Rule = Callable[[Tensor, Tensor], Tensor]
"""(phase before, phase after the detector's projection) → the next phase."""


def _alternate(options: Projections, rule: Rule, model: WaveModel, on_progress: Advance) -> Tensor:
    """The bounded phase [V, H, W] after all projections."""
    phase = model.phase
    for done in range(options.iterations):
        on_progress(done / options.iterations)
        phase = rule(phase, through_detector(model, phase))
    return model.bounded(phase)


def through_detector(model: WaveModel, phase: Tensor) -> Tensor:
    """The phase [V, H, W] nearest to the wave that has the measured amplitudes and comes from `phase` otherwise.

    Beyond the frame nothing was measured, and the amplitude stays. With `U'` the new wave behind the object and U the
    old one, `-ln(U'/U) = dℓ + i dφ` has no branch to choose as long as an iteration changes the phase by less
    than π: a phase of many radians never wraps. The phase of one material nearest to it, in the logarithm, is
    `φ + (dφ + r dℓ) / (1 + r²)`, `r = β/δ`. Frames of one pose give the mean of their changes.
    """
    path, r, sign = model.path, model.ratio, model.sign
    transfer = path.transfer
    before = exit_wave_of(sign * r * phase, sign * phase)
    detector = 1 + torch.fft.ifft2(torch.fft.fft2(before) * transfer)
    gain = _gain(model, phase)
    after = before + torch.fft.ifft2(torch.fft.fft2((gain - 1) * detector) * transfer.conj())
    change = (1 + after) / (1 + before)
    loss, delay = -torch.log(change.abs().clamp_min(DARKEST)), -torch.angle(change)
    return phase + sign * model.spectra.poses.mean((delay + r * loss) / (1 + r**2))


def _gain(model: WaveModel, phase: Tensor) -> Tensor:
    """Factor [V, H, W] of the amplitude on the waves' raster: measured over modelled pixels, one beyond the
    frame and in missing pixels."""
    (my, mx), s = model.margin, model.oversample
    with torch.no_grad():
        gain = model.amplitude / model.image(phase).clamp_min(DARKEST).sqrt()
        gain = gain if model.missing is None else gain.masked_fill(model.missing, 1.0)
    gain = pad(gain, (mx, mx, my, my), value=1.0)
    return gain.repeat_interleave(s, 1).repeat_interleave(s, 2)
