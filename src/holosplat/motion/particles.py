"""Opaque particles in in-line holograms of several cameras: found in 3D at each time, linked, and forecast."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.fft import next_fast_len
from scipy.ndimage import maximum_filter
from torch import Tensor

from ..checks import in_range, require, shaped
from ..frames import block_means
from ..optics.resampling import InLine
from ..ranges import Natural, Signed, ranged
from .track_linking import LinkOptions, Seen, identified, path_degree

NUMBERS = 4
"""Unknowns of a particle: x, y, z, radius."""
STEPS, HALVINGS, STILL = 12, 5, 0.1
"""Gauss–Newton steps at most, how often each is halved, and the share of the standard errors that ends them."""


@dataclass(frozen=True)
@ranged
class ParticleOptions:
    """How particles are found."""

    radius: tuple[float, float] = (10e-6, 80e-6)
    """Radii [m] of the smallest and the largest particle."""
    depth: tuple[Signed, Signed] = (-0.03, 0.03)
    """Where they may be along the beam [m], from the plane z = 0."""
    bins: Natural = 2
    """Pixels that are joined along each side before the fit."""
    rounds: Natural = 3
    """How often particles are looked for beside those that are found."""

    def __post_init__(self) -> None:
        in_range("least radius", self.radius[0], 0.0, self.radius[1], unit="metres")
        require(
            self.depth[0] < self.depth[1],
            f"depth must be two numbers, the smaller one first, but it is {self.depth}; exchange them.",
        )

    @property
    def usual_radius(self) -> float:
        """The geometric mean [m] of both radii, of what is looked for first."""
        return math.sqrt(self.radius[0] * self.radius[1])


@dataclass(frozen=True)
class Particle:
    """An opaque particle at one time. centre: [3] m `(x, y, z)` from the middle of the frame and the plane z = 0;
    radius: [m] of the disc; errors: [4] m, standard errors of x, y, z and radius"""

    centre: np.ndarray
    radius: float
    errors: np.ndarray


class _Hologram:
    """Frames [C, H, W] of one time on a larger raster, and the model of discs in them.

    A disc of radius r has the spectrum `r J₁(2πrf) / f`; behind it the wave lacks `a = disc ∗ Fresnel kernel`, and the
    frame is `1 + c (|1 - Σ a|² - 1)` with the contrast c of each camera (Tyler & Thompson 1976, Optica Acta 23, 685).
    """

    def __init__(self, frames: np.ndarray, optics: InLine, options: ParticleOptions) -> None:
        bins = options.bins
        binned = block_means(frames, bins)
        self.frames = torch.from_numpy(np.ascontiguousarray(binned)).float()
        self.pitch, self.options, self.optics = bins * optics.pixel, options, optics
        far = max(optics.distances) - options.depth[0]
        reach = 0.61 * optics.wavelength * far / options.usual_radius / self.pitch  # of the central disc of diffraction
        lengths = np.add(binned.shape[1:], math.ceil(reach)).tolist()
        self.shape: tuple[int, ...] = tuple(map(next_fast_len, lengths))  # type: ignore[arg-type]
        self.first = [(m - n) // 2 for m, n in zip(self.shape, binned.shape[1:])]
        self.inside = tuple(slice(f, f + n) for f, n in zip(self.first, binned.shape[1:]))
        # from the middle of the uncut frames to that of the raster's sample [0, 0]
        self.origin = [
            (0.5 * bins - 0.5 * n) * optics.pixel - f * self.pitch for n, f in zip(frames.shape[1:], self.first)
        ]
        self.fy = torch.fft.fftfreq(self.shape[0], self.pitch)[:, None]
        self.fx = torch.fft.rfftfreq(self.shape[1], self.pitch)[None]
        self.square = self.fy**2 + self.fx**2
        self.pixel = torch.sinc(self.fy * self.pitch) * torch.sinc(self.fx * self.pitch) / self.pitch**2

    def disc(self, radius: float) -> Tensor:
        """[M, N / 2 + 1] spectrum of a disc [samples]."""
        turns = 2 * math.pi * radius * self.square.sqrt()
        inner = torch.where(turns > 0, 2 * torch.special.bessel_j1(turns) / turns.clamp_min(1e-12), 1.0)
        return math.pi * radius**2 * inner * self.pixel

    def fresnel(self, distance: float) -> Tensor:
        """[M, N / 2 + 1]: the phase `πλz(fx² + fy²)`."""
        return math.pi * self.optics.wavelength * distance * self.square

    def image(self, spectra: Tensor) -> Tensor:
        """[..., H, W] within the frames, of half-spectra [..., M, N / 2 + 1]."""
        return torch.fft.irfft2(spectra, s=self.shape)[(..., *self.inside)]

    def moved(self, x: float, y: float) -> Tensor:
        """[M, N / 2 + 1]: the factor of what is centred at (x, y) [m]."""
        phase = self.fx * (x - self.origin[1]) + self.fy * (y - self.origin[0])
        return torch.polar(torch.ones_like(phase), -2 * math.pi * phase)

    def wave(self, numbers: np.ndarray) -> Tensor:
        """The missing wave [C, H, W] of discs `numbers` [P, 4] [m]."""
        real = torch.zeros((len(self.frames), *self.square.shape), dtype=torch.complex64)
        imaginary = torch.zeros_like(real)
        for x, y, z, radius in numbers:
            spectrum = self.disc(radius) * self.moved(x, y)
            for k, distance in enumerate(self.optics.distances):
                phase = self.fresnel(distance - z)
                real[k] += spectrum * phase.cos()
                imaginary[k] -= spectrum * phase.sin()
        return torch.complex(self.image(real), self.image(imaginary))

    def slopes(self, numbers: np.ndarray) -> Tensor:
        """[4 P, C, H, W]: derivatives of the linear hologram `-2 Re a` by x, y, z and radius [1/m]."""
        found = []
        for x, y, z, radius in numbers:
            moved, disc = self.moved(x, y), self.disc(radius)
            ring = 2 * math.pi * radius * torch.special.bessel_j0(2 * math.pi * radius * self.square.sqrt())
            for distance in self.optics.distances:
                phase = self.fresnel(distance - z)
                shown = disc * phase.cos() * moved
                deep = self.fresnel(1.0) * disc * phase.sin() * moved
                parts = [-2j * math.pi * self.fx * shown, -2j * math.pi * self.fy * shown, deep]
                found.append(-2 * self.image(torch.stack([*parts, ring * self.pixel * phase.cos() * moved])))
        count = len(self.optics.distances)
        return torch.stack(found).unflatten(0, (-1, count)).transpose(1, 2).flatten(0, 1)

    def residual(self, numbers: np.ndarray) -> Tensor:
        """[C, H, W]: frames less their model, with the best contrast of each camera."""
        shown = (1 - self.wave(numbers)).abs().square() - 1
        return self.frames - 1 - self._contrast(shown)[:, None, None] * shown

    def _contrast(self, shown: Tensor) -> Tensor:
        return ((self.frames - 1) * shown).sum((1, 2)) / shown.square().sum((1, 2)).clamp_min(1e-12)

    def fitted(self, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The discs [P, 4] [m] that fit best, from `numbers` on, and their standard errors.

        Gauss–Newton steps with the derivatives of the linear hologram, halved until the misfit falls; they end where
        all are a tenth of the errors. Each camera's contrast is free.
        """
        low, high = self.options.radius
        scale = np.tile([self.pitch, self.pitch, low * high / self.optics.wavelength, self.pitch], len(numbers))
        misfit, errors = float(self.residual(numbers).square().sum()), np.zeros(numbers.size)
        for _ in range(STEPS):
            shown = (1 - self.wave(numbers)).abs().square() - 1
            contrast = self._contrast(shown)[:, None, None]
            columns = (contrast * self.slopes(numbers)).flatten(1) * torch.from_numpy(scale)[:, None].float()
            design = torch.cat([columns, torch.block_diag(*shown.flatten(1))])
            left = (self.frames - 1 - contrast * shown).flatten()
            covariance = np.linalg.pinv((design @ design.T).double().numpy(), hermitian=True)
            step = (covariance @ (design @ left).double().numpy())[: numbers.size]
            errors = np.sqrt(np.diag(covariance)[: numbers.size] * misfit / len(left))
            for share in 0.5 ** np.arange(HALVINGS):
                tried = numbers + share * (step * scale).reshape(numbers.shape)
                tried[:, 2] = np.clip(tried[:, 2], *self.options.depth)
                tried[:, 3] = np.clip(tried[:, 3], low, high)
                new = float(self.residual(tried).square().sum())
                if new < misfit:
                    break
            else:
                break
            numbers, misfit = tried, new
            if np.all(np.abs(share * step) < STILL * errors):
                break
        return numbers, (errors * scale).reshape(numbers.shape)

    def candidates(self, residual: Tensor, known: np.ndarray) -> np.ndarray:
        """Discs [P, 4] [m] of the middle radius that explain a residual, beside those `known`: where the misfit falls
        by more than four numbers and their place cost (Schwarz 1978).

        Frames are correlated with the linear hologram `-2 Re a` at each depth, for all places by one transform.
        """
        radius = self.options.usual_radius
        step = 2 * radius**2 / self.optics.wavelength
        first, last = self.options.depth
        noise = 1.4826 * residual.flatten(1).abs().median(dim=1).values
        weight = torch.zeros((len(residual), *self.shape))
        weight[(slice(None), *self.inside)] = (1 / noise.square())[:, None, None]
        around = torch.zeros_like(weight)
        around[(slice(None), *self.inside)] = residual
        data, seen = torch.fft.rfft2(around * weight), torch.fft.rfft2(weight)
        best, depth = torch.full(self.shape, -math.inf), torch.zeros(self.shape)
        disc = self.disc(radius)
        for z in np.linspace(first, last, max(2, math.ceil((last - first) / step) + 1)):
            product, square = torch.zeros_like(best), torch.zeros_like(best)
            for one, mask, distance in zip(data, seen, self.optics.distances):
                shape = -2 * disc * self.fresnel(distance - z).cos()
                pattern = torch.fft.rfft2(torch.fft.irfft2(shape, s=self.shape).square())
                product += torch.fft.irfft2(one * shape, s=self.shape)
                square += torch.fft.irfft2(mask * pattern.conj(), s=self.shape)
            whole = square.max()
            gain = 0.5 * product.clamp_min(0).square() / square.clamp_min(0.25 * whole)
            better = gain > best
            best, depth = torch.where(better, gain, best), torch.where(better, float(z), depth)
        ring = math.sqrt(self.optics.wavelength * (max(self.optics.distances) - first)) / self.pitch
        peaks = best.numpy() == maximum_filter(best.numpy(), size=2 * round(ring) + 1)
        peaks &= best.numpy() > 0.5 * NUMBERS * math.log(residual.numel()) + math.log(best.numel())
        places = np.argwhere(peaks)
        y, x = ((places[:, k] * self.pitch + self.origin[k]) for k in (0, 1))
        found = np.stack([x, y, depth.numpy()[tuple(places.T)], np.full(len(places), radius)], axis=1)
        apart = np.hypot(*(found[:, None, k] - known[None, :, k] for k in (0, 1))) > 2 * self.options.radius[1]
        return found[apart.all(axis=1)]


def find_particles(frames: np.ndarray, optics: InLine, options: ParticleOptions = ParticleOptions()) -> list[Particle]:
    """The opaque particles in registered frames [C, H, W] of one time, relative to the light.

    They are matched by depth and place in all cameras at once, fitted together, and looked for again in what is left
    (Soulez et al. 2007, J. Opt. Soc. Am. A 24, 1164). All cameras see one wave, so that the twin image of one is no
    particle of all. Particles beyond the frames are found by their fringes.
    """
    shaped("frames", frames, (len(optics.distances), *np.shape(frames)[1:]))
    model = _Hologram(np.asarray(frames), optics, options)
    numbers = errors = np.zeros((0, NUMBERS))
    for _ in range(options.rounds):
        new = model.candidates(model.residual(numbers), numbers)
        if not len(new):
            break
        numbers, errors = model.fitted(np.concatenate([numbers, new]))
    return [Particle(one[:3], float(one[3]), error) for one, error in zip(numbers, errors)]


LINKS = LinkOptions(gate=4.0, change=0.7, gap=3, least=4)
"""Particles move by some radii a time, and the radius of a faint one is uncertain; noise is seen at few times."""


@dataclass(frozen=True)
class ParticlePath:
    """A particle through the times. times: [N] s at which it was seen; centres, errors: [N, 3] m; radius: [m], the
    median; degrees: of the polynomials of time of x, y and z"""

    times: np.ndarray
    centres: np.ndarray
    errors: np.ndarray
    radius: float
    degrees: tuple[int, ...]

    def at(self, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Places [T, 3] m at `times` [T] s, also later ones, and the standard errors [T, 3] m of sightings there.

        They are those of the polynomials' coefficients by the scatter about the path, and this scatter itself, of the
        median sighting. Sightings count by their own errors: beyond the frame they are worth less.
        """
        first, span = self.times[0], self.times[-1] - self.times[0]
        places, errors = np.empty((len(times), 3)), np.empty((len(times), 3))
        for axis, degree in enumerate(self.degrees):
            known = np.vander((self.times - first) / span, degree + 1)
            asked = np.vander((np.asarray(times) - first) / span, degree + 1)
            weights = np.median(self.errors[:, axis]) / self.errors[:, axis]
            inverse = np.linalg.pinv(weights[:, None] * known)
            found = inverse @ (weights * self.centres[:, axis])
            left = weights * (self.centres[:, axis] - known @ found)
            variance = float(left @ left) / max(len(left) - degree - 1, 1)
            places[:, axis] = asked @ found
            errors[:, axis] = np.sqrt(variance * (1 + np.square(asked @ inverse).sum(axis=1)))
        return places, errors


def link_particles(
    found: Sequence[Sequence[Particle]], times: np.ndarray, options: LinkOptions = LINKS
) -> list[ParticlePath]:
    """Paths of the particles `found` at each of `times` [T] s, the longest first; depth counts as exactly as it is
    known beside the other axes."""
    flat = [(t, one) for t, several in enumerate(found) for one in several]
    if not flat:
        return []
    errors = np.median([one.errors for _, one in flat], axis=0)
    scale = np.array([1.0, 1.0, min(1.0, float(errors[:2].mean() / errors[2]))])
    seen = [Seen(t, one.centre * scale, 4 / 3 * math.pi * one.radius**3, False) for t, one in flat]
    paths = []
    for track in identified(seen, np.asarray(times), options):
        when = np.asarray(times)[[seen[k].time for k in track]]
        centres = np.array([flat[k][1].centre for k in track])
        own, scaled = np.array([flat[k][1].errors[:3] for k in track]), (when - when[0]) / (when[-1] - when[0])
        degrees = tuple(path_degree(scaled, axis[:, None], 2, error) for axis, error in zip(centres.T, own.T))
        radius = float(np.median([flat[k][1].radius for k in track]))
        paths.append(ParticlePath(when, centres, own, radius, degrees))
    return paths
