"""Misfit of frames in units of their noise, as a function of line integrals; smooth light is projected out."""

from __future__ import annotations

import math
from collections.abc import Callable
from copy import copy
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor
from torch.nn.functional import pad

from ..matter import DeltaBeta
from ..model import Instrument, LightField
from ..optics.background import Light
from ..optics.noise import NoiseModel
from ..optics.patterns import cosines
from ..optics.retrieval.spectra import Raster, response, squared_frequency
from ..optics.sampling import fringe_sampling
from ..scan import Scan
from ..units import wavelength, wavenumber
from ..volume import LineIntegrals


class LightProjection:
    """The part of images over their noise that uncertain light does not explain, exact for small changes of it.

    Light `1 + M c`, c ~ N(0, C), changes amplitudes by `B c = ½ √I₀ M c`, so that their errors have the covariance
    `P + B C Bᵀ`, of which the inverse is `P⁻¹ - P⁻¹ B R (1 + Rᵀ Bᵀ P⁻¹ B R)⁻¹ Rᵀ Bᵀ P⁻¹`, R Rᵀ = C (Woodbury 1950).

    amplitudes: √I₀ [V, H, W]; covariances: C [V, K, K] of the coefficients of `smooth_modes`; over_noise: P⁻¹ of images
    [V, H, W].
    """

    def __init__(self, amplitudes: Tensor, covariances: Tensor, over_noise: Callable[[Tensor], Tensor]) -> None:
        order = math.isqrt(covariances.shape[1]) - 1
        self._half, self._over_noise = 0.5 * amplitudes, over_noise
        on = amplitudes.device
        self._rows, self._columns = (cosines(n, order, on).float() for n in amplitudes.shape[1:])
        modes = (self._rows[:, None, :, None] * self._columns[None, :, None, :]).flatten(0, 1)
        products = [self._modes_in(over_noise(self._half * mode)) for mode in modes]
        normal = torch.stack(products, dim=2).double().cpu()  # a small system of each view
        strength, vectors = torch.linalg.eigh(covariances)
        roots = vectors * strength.clamp_min(0).sqrt()[:, None]
        inner = roots.mT @ normal @ roots + torch.eye(len(modes), dtype=torch.float64)
        self._gain = (roots @ torch.linalg.solve(0.5 * (inner + inner.mT), roots.mT)).float().to(on)

    def __call__(self, weighted: Tensor) -> Tensor:
        """Images [V, H, W] over their noise, without what light explains."""
        said = torch.einsum("vkl,vl->vk", self._gain, self._modes_in(weighted))
        light = said.unflatten(1, (len(self._rows), len(self._columns)))
        return weighted - self._over_noise(self._half * (self._rows.T @ light @ self._columns))

    def _modes_in(self, images: Tensor) -> Tensor:
        """Bᵀ of images [V, H, W], [V, K]."""
        return (self._rows @ (self._half * images) @ self._columns.T).flatten(1)


DARKEST = 1e-3
"""Least intensity under a root, whose slope would have no bound."""
FAINTEST = 1e-12
"""Power of noise [relative intensity squared] assumed at least, of frames without contrast."""
LEAKED = 0.002
"""Part of the whole contrast of frames that sampled matter leaves unexplained at every spatial frequency."""
LITTLE = 0.02
"""Step of the derivative along a change of the line integrals, as a share of that change."""


@dataclass(frozen=True)
class Misfit:
    """A whitened misfit. value: ½ χ²; of: a number whose gradient by the line integrals `at` is that of the misfit."""

    value: float
    of: Tensor
    at: Tensor

    @cached_property
    def gradient(self) -> Tensor:
        """By the line integrals in pixels [V, H, W]; it costs as much as the value, and is computed on demand."""
        (gradient,) = torch.autograd.grad(self.of, self.at)
        return gradient


class WhitenedFrames:
    """½ Σ |F[√I - √I₀]|² / P over all frames: the negative logarithm of their likelihood, I from the full wave optics.

    Amplitudes √I have the same noise everywhere (Godard et al. 2012, eq. 9), half that of the intensity near one; P is
    its power by `NoiseModel`, at each spatial frequency, with the part of the contrast that sampled matter cannot
    explain (`model_error`) beside it, or frames without noise would be trusted without end. F is the unitary `rfft2`.
    The unknowns are line integrals [V, H, W] of one material's occupancy, in (the smallest) pixels of path length; with
    matter `beyond` the frames, H and W are those of `field`.

    train: the frames; material: δ and β of an occupancy of one; noise: their noise; light: a factor of each frame, None
    for even light; oversample: wave samples a pixel (0: as the first fringe needs); beyond: rows above and below the
    frames, and columns at either side, in which there may be matter; doubt: uneven light that the frames were divided
    by, of which what is not known is then an unknown of each frame (`LightProjection`): P with it in the `noise` is
    only its mean.
    """

    def __init__(
        self,
        train: Scan,
        material: DeltaBeta,
        noise: NoiseModel,
        light: LightField | None = None,
        backend: str = "cpu",
        oversample: int = 0,
        beyond: tuple[int, int] = (0, 0),
        *,
        doubt: Light | None = None,
    ) -> None:
        exposures = train.exposures
        self.train, self.material, self.beyond = train, material, beyond
        self.field = train.views.padded(beyond)
        """The views with the rows and columns beyond."""
        self.instrument = Instrument(exposures, oversample or fringe_sampling(exposures, voxels=1), backend=backend)
        self.shape, self.pixel = (train.views.shape[0], train.views.shape[1]), train.views.finest
        frames, on = torch.from_numpy(train.frames), self.instrument.device
        self._amplitudes = frames.clamp_min(0).sqrt().to(on)
        self.absorbed: Tensor | None = None
        """Line integrals [V, H, W] of β beside that of the material, in (the smallest) pixels; None for none."""
        self._missing = None if train.gaps is None else train.gaps.to(on)
        self._light = None if light is None else light.factor().detach().to(on)
        power = noise.power()
        error = model_error(frames, power)
        self.power = (0.25 * (power + error + FAINTEST)).float().to(on)
        """P [V, H, W//2 + 1], of amplitudes."""
        self._own, self._apart = self.power, None
        if doubt is not None and doubt.background is not None:
            self._own = (0.25 * (doubt.noise.power() + error + FAINTEST)).float().to(on)
            self._apart = LightProjection(self._amplitudes, doubt.background.covariances, self._over_noise)
        self._sampled, self._sharp = False, self._sharpening().to(on)

    @property
    def count(self) -> int:
        """How many pixels all frames have."""
        return self._amplitudes.numel()

    def of_samples(self) -> WhitenedFrames:
        """The same misfit of line integrals [V, H', W'] in pixels at the samples of the waves (`instrument.views`)."""
        found = copy(self)
        found._sampled = True
        return found

    def curvature(self) -> Tensor:
        """About the second derivative [V, H, W//2 + 1] by the lines in the frames, at each frequency of `rfft2`.

        That of a thin object, `(k δ p H / 2)² / P`, and of a shift of the image by a slow change of the phase, a prism:
        `δI = (λz/2π) ∇δφ · ∇I` (from the transport of intensity, Teague 1983).
        """
        exposures = self.train.exposures.optical
        p = exposures.views.pixel_size
        raster = Raster(self.shape, p)
        h = response(exposures, self.material.beta / self.material.delta, raster)
        delta = exposures.refraction(self.material.delta, 0.0)[0]
        unit = torch.from_numpy(wavenumber(exposures.energy_kev) * delta * self.pixel)[:, None, None]
        frames = torch.from_numpy(self.train.frames).double()
        slope2 = torch.zeros(len(frames), dtype=torch.float64)
        for axis in (1, 2):
            if frames.shape[axis] > 1:
                slope2 += frames.diff(dim=axis).square().mean(dim=(1, 2)) / p**2
        reach = torch.from_numpy(wavelength(exposures.energy_kev) * exposures.distance)
        shift = (reach.square() * slope2)[:, None, None] * squared_frequency(raster)
        return (unit.square() * 0.25 * (h.square() + shift)).float().to(self.power) / self.power

    def amplitudes(self, lines: Tensor) -> Tensor:
        """√I [V, H, W] of line integrals [V, H, W] in pixels of path length; differentiable."""
        waves, materials = self._waves(lines)[:, None], [self.material]
        if self.absorbed is not None:
            waves = torch.cat([waves, self._waves(self.absorbed)[:, None]], dim=1)
            materials.append(DeltaBeta(0.0, 1.0))
        frames = self.instrument.frames(LineIntegrals(waves, tuple(materials)))
        frames = frames if self._light is None else frames * self._light
        return frames.clamp_min(DARKEST).sqrt()

    def _waves(self, lines: Tensor) -> Tensor:
        """Line integrals [V, H, W] in pixels as those [m] on the raster of the waves."""
        if self._sampled:
            return lines * self.pixel
        (my, mx), s = self.instrument.margin, self.instrument.oversample
        (my, mx) = (m - more for m, more in zip((my, mx), self.beyond))  # below 0 it cuts
        padded = pad(lines, (mx, mx, my, my)) * self.pixel
        h, w = padded.shape[-2:]
        spectrum = torch.fft.rfft2(padded) * self._sharp
        if s > 1:
            half, columns = (h + 1) // 2, w // 2 + 1
            fine = spectrum.new_zeros(len(spectrum), h * s, w * s // 2 + 1)
            fine[:, :half, :columns] = spectrum[:, :half]
            fine[:, h * s - (h - half) :, :columns] = spectrum[:, half:]
            if w % 2 == 0:
                fine[:, :, w // 2] *= 0.5  # the highest frequency stands for both signs
            spectrum = fine * s**2
        return torch.fft.irfft2(spectrum, s=(h * s, w * s))

    def __call__(self, lines: Tensor) -> Misfit:
        """Misfit of line integrals [V, H, W]."""
        at = lines.detach().requires_grad_()
        difference = self.known(self.amplitudes(at) - self._amplitudes)
        weighted = self.whitened(difference.detach())
        value = 0.5 * float((difference.detach().double() * weighted).sum())
        return Misfit(value, (difference * weighted).sum(), at)

    def whitened(self, images: Tensor) -> Tensor:
        """Images [V, H, W] over the covariance of the amplitudes' errors: their spectra over P, and with doubtful light
        what it does not explain."""
        weighted = self._over_noise(images)
        return weighted if self._apart is None else self._apart(weighted)

    def _over_noise(self, images: Tensor) -> Tensor:
        return torch.fft.irfft2(torch.fft.rfft2(images) / self._own, s=self.shape)

    @property
    def measured(self) -> Tensor:
        """√I₀ [V, H, W]."""
        return self._amplitudes

    def slopes(self, lines: Tensor, changes: list[Tensor], now: Tensor) -> list[Tensor]:
        """Derivatives [V, H, W] of the amplitudes `now` of line integrals [V, H, W] along each of `changes`."""
        with torch.no_grad():
            return [self.known(self.amplitudes(lines + LITTLE * change) - now) / LITTLE for change in changes]

    def known(self, differences: Tensor) -> Tensor:
        """Differences [V, H, W] of amplitudes, 0 in the scan's missing pixels."""
        return differences if self._missing is None else differences.masked_fill(self._missing, 0.0)

    def normal_equations(self, lines: Tensor, changes: list[Tensor]) -> tuple[Tensor, Tensor]:
        """`Jᵀ P⁻¹ J` [K, K] and `-gradient` [K], float64, along K changes [V, H, W] of the line integrals."""
        with torch.no_grad():
            now = self.amplitudes(lines)
        slopes = self.slopes(lines, changes, now)
        weighted = [self.whitened(slope).double().flatten() for slope in slopes]
        missing = self.known(self._amplitudes - now).double().flatten()
        matrix = torch.stack([torch.stack([s.double().flatten() @ w for w in weighted]) for s in slopes])
        return 0.5 * (matrix + matrix.T), torch.stack([w @ missing for w in weighted])

    def _sharpening(self) -> Tensor:
        """Factors [H', W'//2 + 1] of the padded lines' spectra that undo the blur of projected voxels.

        Projectors give means over pixels of the shadows of voxels (twice a box where the projector integrates over
        both, once along an axis whose rows match); waves are wanted as samples of what voxels are the means of once, or
        of matter itself where the waves have finer samples, for the detector integrates over its pixels then.
        """
        (my, mx), s = self.instrument.margin, self.instrument.oversample
        h, w = (n + 2 * m for n, m in zip(self.shape, (my, mx)))
        fy, fx = torch.fft.fftfreq(h)[:, None], torch.fft.rfftfreq(w)
        across = 1 if s == 1 else 2
        along = across - 1 if self.train.views.shares_axis else across
        offset = 0.5 * (s - 1) / s
        turn = torch.exp(-2j * math.pi * offset * (fx + fy))
        return turn / (torch.sinc(fx) ** across * torch.sinc(fy) ** along)


def model_error(frames: Tensor, noise: Tensor) -> Tensor:
    """Power [H, W//2 + 1] of what no sampled matter explains of frames [V, H, W], float64.

    Of the contrast at a frequency f, by its mean over rings and views beyond the `noise` [V, H, W//2 + 1], it is the
    part `1 - sinc f` that a box of one pixel takes away: the error of voxels, strips and samples of waves.
    Optics mixes frequencies, so that `LEAKED` of the whole contrast joins at all of them.
    """
    power = torch.fft.rfft2(frames.double() - 1, norm="ortho").abs().square()
    h, w = frames.shape[1:]
    radius = torch.hypot(torch.fft.fftfreq(h)[:, None].double(), torch.fft.rfftfreq(w).double())
    steps = max(4, min(h, w) // 4)
    ring = (radius * 2 * steps).round().long().clamp_max(steps).flatten()
    signal = (power - noise).mean(dim=0).flatten()
    means = torch.zeros(steps + 1, dtype=torch.float64).index_add(0, ring, signal)
    means = (means / torch.bincount(ring, minlength=steps + 1).clamp_min(1)).clamp_min(0)
    whole = float((power - noise).mean().clamp_min(0))
    blurred = 1 - torch.sinc(radius)
    return blurred.square() * means[ring].reshape(power.shape[1:]) + LEAKED**2 * whole
