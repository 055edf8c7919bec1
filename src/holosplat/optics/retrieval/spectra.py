"""The information of a frame about one material at each frequency: response, noise, and expected power.

The unknown is the phase delay `φ = kδT` [rad]. A thin object's frame is `F[I - 1] = -H F[φ]` with the response
`H = 2 (β/δ cos χ + sin χ)`, `χ = πλz f²` (Cloetens et al. 1999, eq. 3, for one material), times the transfer functions
of point-spread function and pixel. Rasters are real ones: frequencies are those of `rfft2`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from ...checks import finite, require, shaped
from ...ranges import LARGEST, Within, checked_dataclass
from ...scan import Exposures
from ...units import wavelength, wavenumber
from ..noise import NoiseModel, noise_levels, with_gaps
from ..propagation import transfer_phase
from ..sampling import SharedPoses, smooth_margin

TINY = 1e-24
"""Variance added for frames without any contrast."""
Noise = float | NoiseModel | None
"""Standard deviation of all frames, their noise, or None to estimate it."""

LEAST_SIGNAL = 0.01
"""Share of a frame's variance that is taken for signal at least, however strong its noise seems."""


@checked_dataclass
class Prior:
    """Power expected of a phase: `1 / (f² + corner²)^decay`, f in cycles per field of view.

    Projected bodies with sharp edges fall off as f⁻³ to f⁻⁴, and are level below the frequency that their size sets.
    """

    corner: Annotated[float, Within(0.1, LARGEST)] = 3.0
    """Frequency below which the power is level [cycles per field of view]."""
    decay: Annotated[float, Within(0.1, LARGEST)] = 2.0
    """Half the exponent of the fall-off."""


def checked(frames: Tensor | np.ndarray, exposures: Exposures, delta: float) -> Tensor:
    """The frames [V, H, W] as a tensor, if they are finite, floating, and match `exposures`; and δ is not zero.

    A NumPy array of the host's byte order is taken as it is.
    """
    known = str(frames.dtype).removeprefix("torch.").lstrip("<>") in ("float32", "float64", "f4", "f8")
    require(known, f"frames must be float32 or float64 for phase retrieval, but they are {frames.dtype}; convert them.")
    if isinstance(frames, np.ndarray):
        frames = torch.from_numpy(np.ascontiguousarray(frames, dtype=frames.dtype.newbyteorder("=")))
    shaped("frames", frames.detach().cpu().numpy(), (len(exposures), *exposures.views.shape))
    finite("frames", frames.detach().cpu().numpy())
    require(delta != 0, "phase retrieval needs a material that differs from its medium in δ, but δ is 0.")
    return frames


Gaps = Tensor | None
"""Pixels without a value, [V, H, W] bool, or None."""


def column(values: np.ndarray) -> Tensor:
    """Numbers of views [V] as float64 [V, 1, 1], to go with their images."""
    return torch.from_numpy(np.asarray(values, dtype=np.float64))[:, None, None]


def radian(exposures: Exposures, delta: float) -> Tensor:
    """The thickness [V, 1, 1] in metres of matter that delays each view's wave by one radian, 1/kδ, float64; below zero
    for holes in a medium, which advance it."""
    return column(1 / (wavenumber(exposures.energy_kev) * exposures.refraction(delta, 0.0)[0]))


def absorption(exposures: Exposures, ratio: float) -> Tensor:
    """β/δ [V, 1, 1] at each view's energy of matter that has `ratio` at the reference energy, float64."""
    delta, beta = exposures.refraction(1.0, ratio)
    return column(beta / delta)


@dataclass(frozen=True)
class Raster:
    """Samples of a pitch [m]: shape (H, W)."""

    shape: tuple[int, int]
    pitch: float

    @property
    def frequencies(self) -> tuple[np.ndarray, np.ndarray]:
        """fy [H, 1] and fx [W//2 + 1] in 1/m."""
        return np.fft.fftfreq(self.shape[0], self.pitch)[:, None], np.fft.rfftfreq(self.shape[1], self.pitch)


def squared_frequency(raster: Raster) -> Tensor:
    """`fx² + fy²` [H, W//2 + 1] in 1/m², float64."""
    fy, fx = raster.frequencies
    return torch.from_numpy(fy**2 + fx**2)


def fresnel_phase(exposures: Exposures, raster: Raster) -> Tensor:
    """`χ = πλz f²` [V, H, W//2 + 1] of each exposure's distance, or that of the angular spectrum."""
    f2, optics = squared_frequency(raster), (exposures.distance, exposures.energy_kev)
    return transfer_phase(f2, raster.shape, raster.pitch, *optics)


def detector_transfer(exposures: Exposures, raster: Raster) -> Tensor:
    """Transfer function [V, H, W//2 + 1] of the point-spread function and, on finer rasters, of the pixel.

    On a raster of the detector's own pitch the samples of a thickness are its means over pixels already.
    """
    pixel, (fy, fx) = exposures.views.pixel_size, raster.frequencies
    sigma2 = torch.from_numpy((exposures.psf_sigma_px * pixel) ** 2)[:, None, None]
    gauss = torch.exp(-2 * math.pi**2 * sigma2 * squared_frequency(raster))
    if raster.pitch > 0.99 * pixel:
        return gauss
    return gauss * torch.from_numpy(np.abs(np.sinc(fy * pixel) * np.sinc(fx * pixel)))


def response(exposures: Exposures, ratio: float, raster: Raster) -> Tensor:
    """`H` [V, H, W//2 + 1] of a material with β/δ = `ratio` at the reference energy, float64."""
    chi = fresnel_phase(exposures, raster)
    return 2 * (absorption(exposures, ratio) * torch.cos(chi) + torch.sin(chi)) * detector_transfer(exposures, raster)


def sensitivity(exposures: Exposures, ratio: float) -> np.ndarray:
    """How strongly a phase acts on amplitudes at most [V], for a material with β/δ = `ratio`; 1: as fringes do.

    Twice the greatest |β/δ cos χ + sin χ| at the frequencies of the frames, but not above 1: fringes that reach half
    the full response count as full ones. In contact it is 2 |β|/δ, of the order of a thousandth, and what is measured
    in radians or in thickness wants its steps and weights in this unit.
    """
    delta, beta = exposures.refraction(1.0, ratio)
    chi = np.minimum(finest_phase(exposures), 0.5 * np.pi)[:, None] * np.linspace(0, 1, 33)
    return np.minimum(1.0, 2 * np.abs((beta / delta)[:, None] * np.cos(chi) + np.sin(chi)).max(axis=1))


def finest_phase(exposures: Exposures) -> np.ndarray:
    """`χ = πλz f²` [V] at the highest frequency of the frames, in the corner of their spectra: `πλz / 2p²`."""
    optics = exposures.optical
    return 0.5 * np.pi * wavelength(optics.energy_kev) * optics.distance / optics.views.pixel_size**2


def contrast_level(frames: Tensor) -> Tensor:
    """Root mean square [V] of `I - 1`, float64, of pixels that are not NaN."""
    return (frames.detach().double() - 1).square().nanmean(dim=(1, 2)).sqrt()


@dataclass(frozen=True)
class Spectra:
    """The response H and the expected power S of the phase, both [V, H, W//2 + 1], and two standard deviations [V] of
    the frames: of the white noise alone, and of this noise with the model error; grain: power [V, H, W//2 + 1] of
    correlated noise beside both, None without any; leak: power [V, H, W//2 + 1] that a frame's edges carry here from
    half a cycle away; poses: those that several frames show, which have one power. All float64."""

    response: Tensor
    power: Tensor
    noise: Tensor
    error: Tensor
    poses: SharedPoses
    grain: Tensor | None = None
    leak: Tensor | float = 0.0

    @property
    def unexplained(self) -> Tensor:
        """Power [V, H, W//2 + 1], or [V, 1, 1] where it is the same at all frequencies, that is not the phase's."""
        white = self.error.square()[:, None, None] + self.leak
        return white if self.grain is None else white + self.grain

    def noise_of(self, gain: Tensor) -> Tensor:
        """Standard deviation [V] of what filters `gain` [V, H, W//2 + 1] make of the noise of all frames of a pose."""
        if self.grain is None:
            return self.poses.sum(self.noise.square() * gain.square().mean(dim=(1, 2))).sqrt()
        noise = gain.square() * (self.noise.square()[:, None, None] + self.grain)
        return self.poses.sum(noise.mean(dim=(1, 2))).sqrt()

    @property
    def own_inverse(self) -> Tensor:
        """Wiener's inverse `H S / (H² S + σ²)` of the response of each frame by itself."""
        return self.response * self.power / (self.response.square() * self.power + self.unexplained)

    @property
    def inverse(self) -> Tensor:
        """The part of each frame in Wiener's inverse of all frames of its pose, `S H/σ² / (1 + S Σ H²/σ²)`: the least
        squares of Cloetens et al. (1999), eq. 4, with the weights of the noise."""
        if not self.poses.any:
            return self.own_inverse
        weight = self.response / self.unexplained
        return self.power * weight / (1 + self.power * self.poses.sum(self.response * weight))


def spectra(
    frames: Tensor,
    exposures: Exposures,
    h: Tensor,
    raster: Raster,
    noise: Noise,
    model_error: float,
    prior: Prior | None = None,
    *,
    leaks: bool = False,
    missing: Gaps = None,
) -> Spectra:
    """Of frames [V, H, W] and a response h on `raster`; noise: theirs, or None to estimate it (as white noise);
    missing: pixels without a value.

    model_error: the part of the frames' contrast that no model explains. The power has the prior's shape, or the one
    that the frames show themselves (`expected_shapes`), and explains the frames' variance beyond their noise, at the
    frequencies that the detector resolves. leaks: whether what a frame's edges mix into a frequency counts as
    unexplained, for what iterates and restores by its bounds what is damped so.
    """
    known = with_gaps(frames, missing)
    level, grain = _levels(known, exposures, raster, noise)
    error = (level.square() + (model_error * contrast_level(known)).square() + TINY).sqrt()
    found = Spectra(h, h, level, error, SharedPoses(exposures), grain)
    return with_power(found, known, exposures, raster, noise, prior, leaks)


def with_power(
    known: Spectra,
    frames: Tensor,
    exposures: Exposures,
    raster: Raster,
    noise: Noise,
    prior: Prior | None = None,
    leaks: bool = True,
) -> Spectra:
    """`known` with the power of the phase that `frames` show, where pixels without a value are NaN, and its leak."""
    contrast, h = contrast_level(frames), known.response
    all_noise = noise.level if isinstance(noise, NoiseModel) else known.noise
    signal = (contrast.square() - all_noise.square()).clamp_min(LEAST_SIGNAL * contrast.square() + TINY)
    f2, field = squared_frequency(raster), math.prod(exposures.views.shape) * exposures.views.pixel_size**2
    if prior is None:
        shown = _shown(frames.nan_to_num(nan=1.0), exposures, h, raster, known.error, noise)
        corner, decay = (each[:, None, None] for each in shown)
    else:
        corner, decay = prior.corner, prior.decay
    shape = (f2 * field + corner**2) ** -decay
    seen = f2 <= (0.5 / exposures.views.pixel_size) ** 2
    explained = (h.square() * shape)[:, seen].mean(dim=1)
    power, poses = shape * (signal / explained)[:, None, None], known.poses
    if poses.any:  # frames that hardly show the phase hardly say what its power is
        told = (signal / known.error.square())[:, None, None]
        power = poses.sum(told * power) / poses.sum(told)
    leak = _changes(h, raster, exposures).square() * power if leaks else 0.0
    return replace(known, power=power, leak=leak)


def _changes(h: Tensor, raster: Raster, exposures: Exposures) -> Tensor:
    """By how much the response `h` changes [V, H, W//2 + 1] over half a cycle of the frame, which tells frequencies no
    better: its edges mix them, so that where the response passes through zero it is not known to be zero."""
    (rows, columns), (height, width) = raster.shape, exposures.views.shape
    pixel = exposures.views.pixel_size / raster.pitch
    steps = (0.5 * rows / (height * pixel), 0.5 * columns / (width * pixel))  # half a cycle in samples of the raster
    along_y, along_x = torch.gradient(torch.fft.fftshift(h, dim=1), dim=(1, 2))
    change = torch.hypot(steps[0] * along_y, steps[1] * along_x)
    return torch.fft.ifftshift(change, dim=1)


def _shown(
    frames: Tensor, exposures: Exposures, h: Tensor, raster: Raster, error: Tensor, noise: Noise
) -> tuple[Tensor, Tensor]:
    """Corners and decays [V] of the power of the phase that frames show; h: the response on `raster`."""
    own = Raster(exposures.views.shape, exposures.views.pixel_size)
    rows, columns = (
        torch.from_numpy(np.rint(np.abs(f.ravel()) * raster.pitch * n)).long() % n
        for f, n in zip(own.frequencies, raster.shape)
    )
    gain = h[:, rows][:, :, columns.clamp_max(h.shape[2] - 1)].square()
    rest = error.square()[:, None, None]
    if isinstance(noise, NoiseModel):
        rest = rest + noise.power_on(own.shape) - noise.white.square()[:, None, None]
    cycles = (squared_frequency(own) * math.prod(own.shape)).sqrt() * own.pitch
    return expected_shapes(frames, gain, cycles, rest)


def _levels(frames: Tensor, exposures: Exposures, raster: Raster, noise: Noise) -> tuple[Tensor, Tensor | None]:
    """Standard deviations [V] of white noise, and the power of grain on `raster`."""
    if isinstance(noise, NoiseModel):
        finer = round(exposures.views.pixel_size / raster.pitch)
        power = noise.power_on(raster.shape, finer) - noise.white.square()[:, None, None]
        return noise.white, power if noise.has_grain else None
    level = noise_levels(frames) if noise is None else torch.full((len(frames),), noise, dtype=torch.float64)
    return level, None


def part_of(noise: Noise, index: np.ndarray) -> Noise:
    """The noise of some of the frames."""
    return noise[index] if isinstance(noise, NoiseModel) else noise


def filtered(images: Tensor, factor: Tensor) -> Tensor:
    """`images` [V, H, W] with their spectra times `factor` [V or 1, H, W//2 + 1], real; periodic."""
    return torch.fft.irfft2(torch.fft.rfft2(images) * factor, s=images.shape[-2:])


def surrounded(frames: Tensor, exposures: Exposures) -> tuple[Tensor, tuple[slice, slice, slice]]:
    """Contrast `I - 1` in float64 on a raster of twice the frame's size, and the slices that lead back.

    Beyond the frame the edge values go on, and fade within the first fringe: noise that went on for ever would be
    taken for the shadow of matter as large as the raster.
    """
    h, w = frames.shape[-2:]
    my, mx = (min(n - 1, smooth_margin(n, math.ceil(n / 2))) for n in (h, w))
    wide = pad(frames[None].double() - 1, (mx, mx, my, my), mode="replicate")[0]
    fringe = np.sqrt(wavelength(exposures.energy_kev) * exposures.distance) / exposures.views.pixel_size
    length = torch.from_numpy(np.maximum(1.0, 0.5 * fringe))[:, None]
    rows, columns = (torch.exp(-((_beyond(n, m) / length) ** 2)).to(wide) for n, m in ((h, my), (w, mx)))
    return wide * rows[:, :, None] * columns[:, None], (slice(None), slice(my, my + h), slice(mx, mx + w))


def _beyond(length: int, margin: int) -> Tensor:
    """How many pixels each of `length + 2 margin` lies beyond the frame."""
    i = torch.arange(-margin, length + margin, dtype=torch.float64)
    return torch.clamp(torch.maximum(-i, i - (length - 1)), min=0)


CORNERS = np.geomspace(1.5, 16.0, 11)
"""Frequencies [cycles per field of view] below which the power may be level: no body seen whole is larger than the
field, so that its power is level from about a cycle on, and a dozen times smaller ones are hardly resolved."""
DECAYS = np.arange(1.0, 2.01, 0.25)
"""Half the exponents of the fall-off that are tried: textures, bodies with sharp edges (2), and softer ones."""
LOWEST = 2
"""Cycles a frame below which a periodogram of a cut frame holds what lies beside it."""
SCORING = 40
"""Steps of Fisher's scoring for the scale, which converges quadratically."""


def expected_shapes(frames: Tensor, response2: Tensor, cycles: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
    """Corners and decays [V] of the power `A / (f² + corner²)^decay` of the phases, f in cycles per field of view.

    frames: relative intensities [V, H, W]; response2: squared response [V, H, W//2 + 1] at their frequencies; cycles:
    these frequencies [H, W//2 + 1]; noise: power of everything else [V, H, W//2 + 1] or [V, 1, 1].

    The periodogram of each frame, in rings of one cycle, is compared with `A |H|² / (f² + corner²)^decay + noise` by
    Whittle's (1953) likelihood; of all tried shapes the mean by their likelihood is taken. Where the response hides a
    frequency, as it does the lowest, the law goes on from those that are seen. Frames are tapered (Hann), so that
    their edges do not pass for power.
    """
    contrast = frames.detach().cpu().double() - 1
    h, w = contrast.shape[1:]
    taper = torch.hann_window(h + 2, periodic=False)[1:-1, None] * torch.hann_window(w + 2, periodic=False)[1:-1]
    taper = taper.double() / taper.double().square().mean().sqrt()
    power = torch.fft.rfft2((contrast - contrast.mean(dim=(1, 2), keepdim=True)) * taper, norm="ortho").abs().square()
    ring = cycles.round().long().flatten()
    count = torch.bincount(ring).double()
    f = np.arange(len(count), dtype=float)
    used = (count.numpy() > 0) & (f >= LOWEST) & (f <= max(min(h, w) // 2, LOWEST))
    weight, bodies = count.numpy()[used], (f[used] ** 2 + CORNERS[:, None, None] ** 2) ** -DECAYS[:, None]

    def over_rings(image: Tensor) -> np.ndarray:
        values = image.expand(h, w // 2 + 1).flatten().double()
        return (torch.zeros(len(count), dtype=torch.float64).index_add(0, ring, values) / count.clamp_min(1)).numpy()[
            used
        ]

    found = [
        _mean_shape(over_rings(one), bodies * over_rings(gain), over_rings(rest), weight)
        for one, gain, rest in zip(power, response2, noise)
    ]
    corners, decays = zip(*found)
    return torch.tensor(corners, dtype=torch.float64), torch.tensor(decays, dtype=torch.float64)


def _mean_shape(seen: np.ndarray, shape: np.ndarray, rest: np.ndarray, weight: np.ndarray) -> tuple[float, float]:
    """Corner and decay by a ring spectrum `seen` [R]; shape: what each pair of them predicts [C, D, R] up to a scale,
    beside the power of everything else, `rest` [R]; weight: samples of each ring [R]."""
    tiny = np.finfo(float).tiny
    scale = np.maximum((seen - rest).clip(0).sum() / np.maximum(shape.sum(axis=-1), tiny), tiny)[..., None]
    for _ in range(SCORING):
        model = scale * shape + rest
        score, information = (
            (weight * part / model**2).sum(axis=-1, keepdims=True) for part in (shape * (seen - model), shape**2)
        )
        scale = np.maximum(scale + score / np.maximum(information, tiny), 1e-3 * scale)
    model = np.maximum(scale * shape + rest, tiny)
    likelihood = -(weight * (seen / model + np.log(model))).sum(axis=-1)
    share = np.exp(likelihood - likelihood.max())
    share /= share.sum()
    corner = np.exp((share.sum(axis=1) * np.log(CORNERS)).sum())
    return float(corner), float((share.sum(axis=0) * DECAYS).sum())
