"""The full wave optics of one material in single views: phase in, frames and gradients out."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate, pad

from ...backends import device, resolve
from ...progress import Advance
from ...ranges import Natural, Weight, checked_dataclass
from ...scan import Exposures
from ...units import wavelength
from ..hologram import hologram, optical_path
from ..sampling import alike, fringe_sampling, padding
from .bounded import FIXED, MODEL_ERROR, NOWHERE, Estimate, Leaves, bounded_estimate
from .spectra import (
    Gaps,
    Noise,
    Prior,
    Raster,
    absorption,
    checked,
    column,
    filtered,
    part_of,
    radian,
    response,
    sensitivity,
    spectra,
    squared_frequency,
)

DARKEST = 1e-3
"""Least intensity under a root, whose slope would have no bound."""
SHARPENING = 3
"""Rounds that fit a finer phase to the means of the pixels; the remaining difference is then added to their samples."""
CROSS_TERM = 4.0
"""Weight of the contrast's slope in the curvature; large enough that most first steps are taken."""


@checked_dataclass
class WaveOptions:
    """Options of any retrieval through the wave optics."""

    noise: Noise = None
    """Standard deviation of the frames, or their noise model (default: estimated from them)."""
    backend: str = "cpu"
    """Implementation of the wave optics (see `backends`)."""


@checked_dataclass
class Regularised(WaveOptions):
    """Options of the fits through the wave optics."""

    iterations: Natural = 60
    """Steps, each one evaluation of the wave optics and its gradient."""
    weight: Weight = 1.0
    """Weight of the regularisation; 1 is the Bayesian weight under the method's assumptions on the matter."""
    leaves: Leaves | None = None
    """Whether matter goes on above and below the frames, and at their sides (default: that is not known)."""
    prior: Prior | None = None
    """Expected power of the phase (default: the one that the frames show)."""
    lacking: bool = False
    """Whether frames show what a result lacks (`bounded_estimate`)."""


class WaveModel:
    """Frames [V, h, w] as a function of the phase delay [V, H, W] in radians, `phase = k|δ|T`, on the waves' raster.

    The raster is the frame padded by the fringes' reach, `oversample` times finer; `support` [V, H, W] marks the
    samples where matter may be: where the estimate has matter, and beyond the frame's border where the estimate touches
    it. float32 frames are computed by `backend`, float64 ones by `reference`. `phase` is the estimate to start from,
    `lacks` [V] the mean square of what it lacked at first, `missing` [V, h, w] marks pixels without a value, which have
    no part in the misfit, `ratio` the matter's β/δ at the frames' one energy, `sign` that of its δ (-1: holes, which
    advance waves), `two_sided` whether phases may be negative, and `strongest` [V, 1, 1] about the curvature of
    the strongest frequency: 1 where fringes are seen, and far less where hardly any are.
    """

    def __init__(
        self,
        frames: Tensor,
        exposures: Exposures,
        ratio: float,
        noise: Noise,
        backend: str = "cpu",
        leaves: Leaves | None = None,
        prior: Prior | None = None,
        *,
        sign: float = 1.0,
        missing: Gaps = None,
        two_sided: bool = False,
        lacking: bool = False,
    ) -> None:
        told = {"missing": missing, "two_sided": two_sided, "lacking": lacking}
        estimate = bounded_estimate(frames, exposures, ratio, noise, leaves, prior, sign, **told)
        self.sign, self.least = sign, -math.inf if two_sided else 0.0
        energy = exposures.one_energy("the wave model of a phase retrieval")
        self.exposures, self.ratio = exposures, float(absorption(exposures, ratio)[0])
        self.backend = resolve("reference" if frames.dtype == torch.float64 else backend)
        self.frames = frames.detach().to(device(self.backend))
        self.amplitude = self.frames.clamp_min(0).sqrt()
        self.missing = None if missing is None else missing.to(self.frames.device)
        self.oversample = fringe_sampling(exposures, voxels=1)
        self.margin = padding(exposures, self.oversample)
        views = exposures.views.padded(self.margin).refined(self.oversample)
        self.raster = Raster(views.shape, views.pixel_size)
        my, mx = (m * self.oversample for m in self.margin)
        self.path = optical_path(
            views.shape,
            views.pixel_size,
            energy,
            exposures.distance,
            exposures.psf_sigma_px * self.oversample,
            (exposures.views.shape, (my, mx), self.oversample),
            frames.dtype,
        ).to(self.frames.device)
        h, prior = response(exposures, ratio, self.raster), prior or (FIXED if any(leaves or NOWHERE) else None)
        self.spectra = spectra(frames, exposures, h, self.raster, noise, MODEL_ERROR, prior, missing=missing)
        self.strongest = self.spectra.poses.sum(column(sensitivity(exposures, ratio) ** 2))
        self.support, self.phase = self._spread(estimate)
        self.lacks = estimate.lacks

    def _spread(self, estimate: Estimate) -> tuple[Tensor, Tensor]:
        """The estimate's support and phase on the waves' raster, the phase with the same means over pixels."""
        (my, mx), s = self.margin, self.oversample
        like = {"device": self.frames.device, "dtype": self.frames.dtype}
        support, phase = (
            pad(image[None].to(**like), (mx, mx, my, my), mode="replicate")[0]
            for image in (estimate.support, estimate.phase)
        )
        support = support.repeat_interleave(s, 1).repeat_interleave(s, 2)
        if s > 1:
            coarse, phase = phase, torch.zeros_like(support)
            for _ in range(SHARPENING):
                missing = coarse - avg_pool2d(phase[None], s)[0]
                phase = phase + interpolate(missing[None], scale_factor=s, mode="bilinear", align_corners=False)[0]
            missing = coarse - avg_pool2d(phase[None], s)[0]
            phase = phase + missing.repeat_interleave(s, 1).repeat_interleave(s, 2)
        return support, self.bounded(phase, support)

    def bounded(self, phase: Tensor, support: Tensor | None = None) -> Tensor:
        """The phase where it may be (positive, unless matter is two-sided, and inside the support), zero elsewhere."""
        return phase.clamp_min(self.least) * (self.support if support is None else support)

    def thickness(self, phase: Tensor, delta: float) -> Tensor:
        """Means over the frame's pixels [V, h, w], in metres."""
        (my, mx), s, (h, w) = self.margin, self.oversample, self.exposures.views.shape
        inside = phase[:, my * s : (my + h) * s, mx * s : (mx + w) * s]
        radians = radian(self.exposures, abs(delta)).to(inside.device, inside.dtype)
        return (avg_pool2d(inside[None], s)[0] if s > 1 else inside) * radians

    def image(self, phase: Tensor) -> Tensor:
        """Frames [V, h, w]; differentiable once."""
        return hologram(phase[:, None], [(self.sign, self.sign * self.ratio)], self.path, self.backend)

    def misfit(self, phase: Tensor) -> tuple[Tensor, Tensor]:
        """`½ Σ (√I(φ) - √I)²` [V], float64, over all frames of the pose of each, and its gradient [V, H, W].

        Roots of counts have the same variance, ¼, everywhere (Anscombe 1948), so each pixel counts as it should.
        """
        at = phase.detach().requires_grad_()
        difference = self.image(at).clamp_min(DARKEST).sqrt() - self.amplitude
        difference = difference if self.missing is None else difference.masked_fill(self.missing, 0.0)
        value = 0.5 * difference.double().square().sum(dim=(1, 2))
        (gradient,) = torch.autograd.grad(value.sum(), at)
        poses = self.spectra.poses
        return poses.sum(value.detach()), poses.sum(gradient)

    def curvature(self) -> Tensor:
        """About the misfit's second derivative [V, H, W//2 + 1] by spatial frequency, never too small at the lowest.

        `H²/4` is the derivative for a thin object. Behind a thick object a slow change of phase, a little prism, shifts
        the image: `δI = (λz/2π) ∇δφ · ∇I` (from the transport of intensity, Teague 1983), which is by far the larger
        term at low frequencies.
        """
        i = self.frames.double()
        slope2 = i.diff(dim=1).square().mean(dim=(1, 2)) + i.diff(dim=2).square().mean(dim=(1, 2))
        slope2 = slope2.cpu() / self.exposures.views.pixel_size**2
        lam_z = torch.from_numpy(wavelength(self.exposures.energy_kev) * self.exposures.distance)
        shift = (lam_z.square() * slope2)[:, None, None] * squared_frequency(self.raster)
        each = 0.25 * self.spectra.response.square() + CROSS_TERM * shift
        return self.spectra.poses.sum(each) / self.oversample**2

    def filter(self, images: Tensor, factor: Tensor) -> Tensor:
        """`images` [V, H, W] with their spectra times `factor` [V, H, W//2 + 1]."""
        return filtered(images, factor.to(images.device, images.dtype))


def view_by_view(
    frames: Tensor,
    exposures: Exposures,
    material: tuple[float, float],
    options: WaveOptions,
    solve: Callable[[WaveModel, Advance], Tensor],
    beside: tuple[Gaps, bool, Advance],
) -> Tensor:
    """Thickness [V, H, W] [m] by the phases that `solve(model, on_progress)` finds for views `alike`, some at a time.

    material: δ and β; beside: missing pixels, whether phases are `two_sided`, and progress. The frames are checked.
    """
    (delta, beta), (missing, two_sided, on_progress) = material, beside
    frames = checked(frames, exposures, delta)
    how = options if isinstance(options, Regularised) else Regularised()
    found, done = torch.empty_like(frames), 0
    for index in alike(exposures):
        start, share = done / len(exposures), len(index) / len(exposures)
        gaps = None if missing is None else missing[index]
        seen = (frames[index], exposures[index], beta / delta, part_of(options.noise, index))
        told = {"sign": math.copysign(1.0, delta), "missing": gaps, "two_sided": two_sided, "lacking": how.lacking}
        model = WaveModel(*seen, options.backend, how.leaves, how.prior, **told)
        part = model.thickness(solve(model, lambda f, a=start, b=share: on_progress(a + b * f)), delta)
        found[index] = part.to(frames.device, frames.dtype)
        done += len(index)
    on_progress(1.0)
    return found
