"""The data term: differences of predicted and measured frames, weighted by an `Objective`, the same for every
representation; priors of poses and light."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

from ...checks import InputError, require
from ...matter import Matter
from ...model import Instrument, Model
from ...optics.noise import noise_level, noise_levels, noise_share, sure_noise
from ...optics.propagation import blur
from ...optics.retrieval.spectra import sensitivity
from ...ranges import Pixels, Share, Weight, checked_dataclass
from ...scan import Exposures, Scan
from ...units import wavelength, wavenumber
from ..fidelity import Target, l1_and_ssim
from ..problem import FIXED, Batch, LossPart, Term
from . import comparisons

IMAGE_TERMS = ("l1", "l2_amplitude", "ssim", "tv_image", "frc", "rounded", "spectral")
"""The weights of which one at least must be above zero."""
VOLUME_TERMS = ("tv_volume", "overfull", "two_levels")


@checked_dataclass
class Objective:
    """Weights of the terms; a weight of zero leaves the term out.

    The first seven compare predicted with measured frames, in units of the training frames' range. The terms on the
    volume see what the object adds up to; they are sums along the beam in units of 100 voxels, mean over pixels, so
    that they weigh the same however fine the pixels or wide the field, and they weigh more with fewer views (the
    weights are those for eight, and go with one over the root).
    """

    l1: float = 1.0
    """Mean absolute difference of frames."""
    l2_amplitude: float = 0.0
    """Mean squared difference of amplitudes √I (Godard et al. 2012, eq. 9)."""
    ssim: float = 0.0
    """1 - SSIM."""
    tv_image: float = 0.0
    """Total variation of the predicted frames."""
    frc: float = 0.0
    """1 - FRCM; the weight is ramped from 0."""
    rounded: float = 0.0
    """`√(r² + c²) - c` of the differences r, smooth where they may be noise."""
    spectral: float = 0.0
    """Differences of amplitudes in pixels of thickness, low frequencies raised (`fit.terms.frames`)."""
    frc_ramp: Share = 1.0
    """Share of the steps over which the weight of `frc` is ramped."""
    noise_width: float = 0.0
    """Differences below so many standard deviations of the frames' own noise count in `l1` by their square."""
    coarse: Pixels = 0.0
    """`l1` compares frames blurred by so many pixels at first, where noise is half their contrast or more (by less in
    proportion where it is less), and not blurred at the end."""
    rounding: Weight = 3.0
    """c of `rounded`, in standard deviations of the noise."""
    floor: float = 0.1
    """`spectral`: the smaller, the larger the shapes that are fitted, and the more of the noise."""
    anisotropy: float = 0.0
    """Gaussians: longest over shortest axis beyond `anisotropy_limit`."""
    anisotropy_limit: float = 10.0
    """Ratio of axes that costs nothing."""
    tv_volume: float = 0.0
    """Total variation of the volume."""
    overfull: float = 0.0
    """Square of what exceeds an occupancy of one; only where values are occupancies of a known level."""
    two_levels: float = 0.0
    """Occupancies between nothing and one; ramped from 0, for at its beginning matter may still be too faint."""
    noise_gain: float = 0.0
    """What the weight of `two_levels` grows by, times the share of the frames' contrast that is noise."""

    def __post_init__(self) -> None:
        compared = sum(getattr(self, name) for name in IMAGE_TERMS)
        require(compared > 0, f"the objective needs a term on the frames: one of {', '.join(IMAGE_TERMS)}.")
        require(self.floor > 0, f"floor must be positive, but it is {self.floor}.")

    @property
    def uses_volume(self) -> bool:
        """Whether a term needs the voxelised object."""
        return any(getattr(self, name) > 0 for name in VOLUME_TERMS)


DARKEST = 1e-12
"""Smallest intensity whose root is taken: the slope of √I has a pole at zero."""
NOISE_FLOOR = 5.0
"""What the floor rises by for every pixel of thickness that the noise amounts to."""


class SpectralMisfit:
    """½ Σ (r, W r) over the pixels of each view, with `r = (√I - √I₀) / (k p |δ| s)` and I from the full wave model.

    Amplitudes √I have the same noise everywhere (Godard et al. 2012, eq. 9). A pixel of thickness p of the material
    changes them by up to k p |δ| s, so r is a thickness in pixels; δ, β: of the first material of `matter`; s: 1 where
    fringes are seen, else less (`optics.retrieval.spectra.sensitivity`). W divides the spectrum by `H² + f²`: H s =
    sin χ + (β/δ) cos χ is the linear response of single views (Cloetens et al. 1999, eq. 3; χ = πλz f²) up to its first
    maximum, and H = 1/s beyond. Without W, shapes larger than some fringes hardly count. The smaller f, the larger the
    shapes that are fitted, and the more of the noise: f is `floor` and more where frames are noisy. Errors:
    `InputError` for matter whose δ is zero.
    """

    def __init__(self, train: Scan, instrument: Instrument, matter: Matter, floor: float) -> None:
        require(matter.delta != 0, "a spectral misfit needs a material with a δ, but it is 0.")
        on, exposures = instrument.device, train.exposures
        ratio = matter.beta / matter.delta
        strongest = sensitivity(exposures, ratio)
        delta = exposures.refraction(abs(matter.delta), 0.0)[0]
        phase = wavenumber(exposures.energy_kev) * delta * train.views.finest
        unit = phase * strongest
        self._unit = torch.from_numpy(unit).float()[:, None, None].to(on)
        self._amplitudes = torch.from_numpy(train.frames).clamp_min(0).sqrt().to(on)
        self._missing = None if train.gaps is None else train.gaps.to(on)
        response = linear_response(exposures, ratio) / torch.from_numpy(strongest)[:, None, None]
        self.noise = noise_level(train.measured.clamp_min(0).sqrt()) / float(unit.mean())
        """Standard deviation of r that the noise of the measured frames gives [pixels of thickness]."""
        self.floor = floor + NOISE_FLOOR * self.noise
        """f, which noise has raised."""
        self._weights = (1 / (response**2 + self.floor**2)).float().to(on)

    def __call__(self, frames: Tensor, index: Tensor | None = None) -> Tensor:
        """Misfits [V] of predicted frames [V, H, W] of all views, or of the views `index` [V]."""
        measured, weights, unit = self._amplitudes, self._weights, self._unit
        if index is not None:
            measured, weights, unit = measured[index], weights[index], unit[index]
        residual = (frames.clamp_min(DARKEST).sqrt() - measured) / unit
        if self._missing is not None:
            residual = residual.masked_fill(self._missing if index is None else self._missing[index], 0.0)
        shape = (residual.shape[-2], residual.shape[-1])
        weighted = torch.fft.irfft2(torch.fft.rfft2(residual) * weights, s=shape)
        return 0.5 * (residual * weighted).sum(dim=(1, 2))


def linear_response(exposures: Exposures, absorption: float) -> Tensor:
    """|H| [V, H, W//2 + 1] for `rfft2`, float64, of a thin object with β/δ = `absorption` at the reference energy;
    1 beyond its maximum."""
    exposures = exposures.optical
    views = exposures.views
    fy, fx = np.fft.fftfreq(views.shape[0], views.pixel_size), np.fft.rfftfreq(views.shape[1], views.pixel_size)
    reach = (wavelength(exposures.energy_kev) * exposures.distance)[:, None, None]
    chi = np.pi * reach * (fy[:, None] ** 2 + fx**2)
    delta, beta = (values[:, None, None] for values in exposures.refraction(1.0, absorption))
    response = np.abs(np.sin(chi) + beta / delta * np.cos(chi))
    return torch.from_numpy(np.where(chi < 0.5 * np.pi, response, 1.0))


DARK = 0.05
"""Relative intensity below which noise falls no further."""
COARSEST_NOISE = 0.5
"""Noise, as a share of the frames' contrast, from which on frames are blurred by all of `Objective.coarse` at first."""
LEAST_BLUR = 0.1
"""Pixels below which a blur changes nothing, and is left out."""
SMALLEST_ROUNDING = 1e-6
"""Of `rounded` at zero, in units of the frames' range."""

Weighted = tuple[float | Tensor, Tensor]
"""Weight, and value [V] of each view."""


class FrameTerm:
    """The terms on frames: mean over the batch's views of the weighted sum of the comparisons in use.

    The scan's missing pixels have no part in it.
    detach_worst: the thesis' rule, views whose loss exceeds the batch's median give no gradient. low, span: the affine
    map that takes the training frames' minimum and maximum to 0 and 1.
    """

    def __init__(
        self, train: Scan, instrument: Instrument, objective: Objective, matter: Matter, detach_worst: bool = False
    ) -> None:
        """train: the frames to fit; matter: what the object is made of, in whose thickness `spectral` is measured."""
        self.objective, self._detach_worst = objective, detach_worst
        self.names = ("frames", *(name for name in IMAGE_TERMS if getattr(objective, name) > 0))
        measured = torch.from_numpy(train.frames)
        self.low, high = float(measured.min()), float(measured.max())
        self.span = high - self.low
        frames = measured.to(instrument.device)
        self._target = Target(frames, self.low, self.span, instrument.backend)
        self._missing = None if train.gaps is None else train.gaps.to(frames.device)
        if objective.ssim > 0:
            _ = self._target.statistics  # once, for all subsets of views
        coarse = objective.coarse * min(1.0, noise_share(train.measured) / COARSEST_NOISE) if objective.coarse else 0.0
        self._blur = NarrowingBlur(frames.shape[1:], coarse, frames.device) if coarse > LEAST_BLUR else None
        if objective.noise_width > 0 or self._blur:
            noise = photon_noise(train.measured).nan_to_num()
            self._width = (objective.noise_width * noise).clamp_min(1e-6 * self.span).to(frames.device)
        noise = float(noise_levels(train.measured).mean()) / self.span if objective.rounded > 0 else 0.0
        self._rounding = max(SMALLEST_ROUNDING, objective.rounding * noise)
        self.spectral = SpectralMisfit(train, instrument, matter, objective.floor) if objective.spectral > 0 else None
        self.resolved = self._resolved(coarse if self._blur else 0.0)
        """The objective's options as the frames determine them: `coarse` [pixels], `noise_width` (its mean over the
        pixels) and `rounding` in units of the frames' range, `floor`."""

    def _resolved(self, coarse: float) -> dict[str, float]:
        w, found = self.objective, dict[str, float]()
        if w.coarse > 0:
            found["coarse"] = coarse
        if w.noise_width > 0:
            found["noise_width"] = float(self._width.mean()) / self.span
        if w.rounded > 0:
            found["rounding"] = self._rounding
        return found if self.spectral is None else found | {"floor": self.spectral.floor}

    def __call__(self, model: Model, batch: Batch) -> Sequence[LossPart]:
        """The loss of the frames, and the comparisons that it is made of."""
        per_view, shown = self.of_views(model, batch)
        if self._detach_worst and len(per_view) > 1:
            per_view = torch.where(per_view > per_view.detach().median(), per_view.detach(), per_view)
        return [LossPart("frames", 1.0, per_view.mean()), *shown]

    def of_views(self, model: Model, batch: Batch) -> tuple[Tensor, list[LossPart]]:
        """The loss [V] of each view, and the means of the comparisons that it is made of."""
        parts = self.compared(model.frames(batch.index), batch)
        per_view = sum(weight * value for weight, value in parts.values())
        assert isinstance(per_view, Tensor)
        return per_view, [LossPart(name, None, value.detach().mean()) for name, (_, value) in parts.items()]

    def compared(self, predicted: Tensor, batch: Batch) -> dict[str, Weighted]:
        """Weight and value [V] of every comparison in use."""
        w, target = self.objective, self._target if batch.index is None else self._target[batch.index]
        if self._missing is not None:  # pixels without a value agree with any prediction
            missing = self._missing if batch.index is None else self._missing.index_select(0, batch.index)
            predicted = torch.where(missing, target.frames, predicted)
        fused = l1_and_ssim(predicted, target) if w.ssim > 0 else None
        a, b = ((f - self.low) / self.span if w.tv_image + w.frc > 0 else f for f in (predicted, target.frames))
        table: dict[str, Callable[[], Tensor]] = {
            "l1": lambda: self._absolute(predicted, target, batch) if fused is None or self._noisy else fused[0],
            "l2_amplitude": lambda: comparisons.l2_amplitude(predicted, target.frames),
            "tv_image": lambda: comparisons.tv_image(a),
            "frc": lambda: comparisons.one_minus_frcm(a, b),
            "rounded": lambda: comparisons.rounded((predicted - target.frames) / self.span, self._rounding),
            "spectral": lambda: self._spectral(predicted, batch),
        }
        if fused is not None:
            table["ssim"] = lambda: fused[1]
        ramps = {"frc": (batch.progress / max(w.frc_ramp, 1e-9)).clamp_max(1.0)}
        weights = {name: getattr(w, name) for name in IMAGE_TERMS}
        return {n: (weight * ramps.get(n, 1.0), table[n]()) for n, weight in weights.items() if weight > 0}

    def _spectral(self, predicted: Tensor, batch: Batch) -> Tensor:
        assert self.spectral is not None
        return self.spectral(predicted, batch.index)

    @property
    def _noisy(self) -> bool:
        """Whether differences within the noise count less, or frames are compared coarse to fine."""
        return self.objective.noise_width > 0 or self._blur is not None

    def _absolute(self, predicted: Tensor, target: Target, batch: Batch) -> Tensor:
        """Mean absolute differences [V], or Huber's function of those of frames that are as blurred as is due."""
        measured = target.frames
        if not self._noisy:
            return comparisons.l1(predicted, measured) / self.span
        width = self._width if batch.index is None else self._width.index_select(0, batch.index)
        if self._blur:
            predicted, measured = (self._blur(frames, batch.progress) for frames in (predicted, measured))
        return comparisons.huber(predicted, measured, width) / self.span


class ProfileLikelihood:
    """Minus the log-likelihood of frames whose noise levels are not known, in units of `nat`: the mean over views of
    the logarithm of the loss that `FrameTerm` gives each.

    With the variance of N pixels profiled out, the logarithm of the likelihood of residuals r is -N/2 log Σ r² (Seber &
    Wild 2003, "Nonlinear Regression", section 2.2.1). So priors need no estimate of the noise, and what the model
    cannot explain counts as noise.
    """

    def __init__(self, frames: FrameTerm, pixels: int, alike: bool = False) -> None:
        """pixels: of all frames, those without a value left out; alike: all views of a batch have one level, as where
        their poses are not known: what a wrong pose leaves is no noise."""
        self._frames, self.names, self.resolved, self._alike = frames, frames.names, frames.resolved, alike
        self.nat = 2 / pixels
        """A unit of minus the logarithm of a probability, in units of this term."""

    def __call__(self, model: Model, batch: Batch) -> Sequence[LossPart]:
        """The one part, and the comparisons that it is made of."""
        per_view, shown = self._frames.of_views(model, batch)
        level = per_view.mean() if self._alike else per_view
        least = torch.finfo(level.dtype).tiny
        return [LossPart("frames", 1.0, level.clamp_min(least).double().log().mean()), *shown]


class NarrowingBlur:
    """A Gaussian blur of frames of `shape` whose standard deviation falls from `sigma` [pixels] to 0 during the fit."""

    def __init__(self, shape: Sequence[int], sigma: float, device: torch.device) -> None:
        rows, columns = torch.fft.fftfreq(shape[0]), torch.fft.rfftfreq(shape[1])
        self._exponent = (-2 * (math.pi * sigma) ** 2 * (rows[:, None] ** 2 + columns**2)).to(device)

    def __call__(self, frames: Tensor, progress: Tensor) -> Tensor:
        """Frames [V, H, W], blurred as is due when `progress` [] of the steps are done; periodic."""
        return blur(frames, torch.exp((1 - progress) ** 2 * self._exponent))


def photon_noise(frames: Tensor) -> Tensor:
    """Standard deviation of each pixel of relative frames [V, H, W] that photons make noisy.

    The frames' own noise is that of their quiet parts, where the intensity is about 1, and goes with its root.
    """
    return sure_noise(frames).to(frames)[:, None, None] * frames.clamp_min(DARK).sqrt()


class Quadratic:
    """Half the sum of squares of a model's parameters, each in units of how far off it is expected to be."""

    def __init__(self, name: str, weight: float, expected: dict[str, float]) -> None:
        """expected: standard deviation of each parameter by the name `part.parameter`."""
        self.names, self.resolved = (name,), FIXED
        self._weight, self._expected = weight, expected

    def __call__(self, model: Model, batch: Batch) -> Sequence[LossPart]:
        """The one part."""
        parameters = model.parameters()
        squares = [(parameters[name] / deviation).square().sum() for name, deviation in self._expected.items()]
        return [LossPart(self.names[0], self._weight, 0.5 * torch.stack([s.to(torch.float32) for s in squares]).sum())]


EXPECTED = {
    "alignment.turns": 0.01,
    "alignment.shifts": 1.0,
    "alignment.stretches": 0.02,
    "alignment.blurs": 0.5,
    "alignment.energies": 0.01,
    "alignment.bandwidths": 0.01,
    "light.coefficients": 0.02,
}
"""Standard deviations where nobody says otherwise: [rad], [pixels], share of the distance, [pixels], shares of
the energy (twice), share of light."""


def alignment_prior(weight: float, model: Model, train: Scan) -> Term:
    """Poses, distances, blurs, energies and bandwidths near to the plan; `InputError` for a model without alignment."""
    return _quadratic("alignment_prior", "alignment.", weight, model.parameters())


def light_prior(weight: float, model: Model, train: Scan) -> Term:
    """Light that is nearly even; `InputError` for a model without a light field."""
    return _quadratic("light_prior", "light.", weight, model.parameters())


def _quadratic(name: str, prefix: str, weight: float, parameters: dict[str, Tensor]) -> Quadratic:
    own = {key: EXPECTED[key] for key in parameters if key.startswith(prefix)}
    if not own:
        raise InputError(f"the term {name} needs a model with {prefix}*, but it has {', '.join(parameters)}.")
    return Quadratic(name, weight, own)
