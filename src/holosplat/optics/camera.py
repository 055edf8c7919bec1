"""From photons to counts: an integrating camera with a scintillator, and pulses of a free-electron laser, each of its
own energy, place and structure, drawn from a low-rank model.

Flat fields of such sources are a mean and a few principal components with random weights (Buakor et al. 2022, Opt.
Express 30, 10633; Birnsteinova et al. 2023, J. Synchrotron Rad. 30, 1030). Here the components are made, not measured:
a shift of the beam to first order, and random fields whose weights fall off as a power of their number.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from scipy.fft import dctn, idctn

from ..checks import positive, require
from ..ranges import Pixels, Positive, Share, Weight, Within, checked_dataclass

BITS = (10, 16)
FLAT_LEVEL = 0.4
"""Part of the camera's range that a mean flat frame fills where no gain is given."""
HOT_LEVELS = (0.5, 1.2)
"""Range of the levels of hot pixels without light, as parts of the camera's range; pixels above 1 are saturated."""


GAINS = 1e-6, 1e6
"""Counts that a photon may give."""


@checked_dataclass
class Camera:
    """A camera: photons in, whole numbers of counts out."""

    bits: Annotated[int, Within(*BITS)] = 12
    """Bits of a count (10 to 16); brighter pixels are saturated."""
    gain: Annotated[float, Within(*GAINS)] | None = None
    """Counts a detected photon gives (default: such that a mean flat fills 40 % of the range)."""
    offset: float = 100.0
    """Counts without light."""
    read_noise: Weight = 2.0
    """Standard deviation of the read-out noise [counts]."""
    gain_spread: Annotated[float, Within(0, 0.3)] = 0.02
    """Standard deviation of the pixels' gains, as a part of the gain."""
    offset_spread: Weight = 2.0
    """Standard deviation of the pixels' offsets [counts]."""
    dead: float = 0.0005
    """Share of pixels that see no light."""
    hot: float = 0.0005
    """Share of pixels that are bright without light."""
    scintillator_px: Pixels = 0.0
    """Standard deviation of a Gaussian by which the scintillator spreads the light of each photon [pixels]."""

    def __post_init__(self) -> None:
        require(
            self.offset < self.most, f"offset must be below the range of {self.most} counts, but it is {self.offset}."
        )
        require(
            self.dead + self.hot <= 0.2, f"dead and hot pixels must be at most a fifth, but are {self.dead + self.hot}."
        )

    @property
    def most(self) -> int:
        """The greatest count."""
        return 2**self.bits - 1

    def gain_for(self, photons_per_pixel: float) -> float:
        """Counts a photon, for flats of `photons_per_pixel` photons."""
        if self.gain is not None:
            return self.gain
        return (FLAT_LEVEL * self.most - self.offset) / positive("photons_per_pixel", photons_per_pixel)


@dataclass(frozen=True)
class Sensor:
    """One camera, its pixels known: gain, offset [H, W] (counts a photon, counts); dead, hot [H, W] bool."""

    camera: Camera
    gain: np.ndarray
    offset: np.ndarray
    dead: np.ndarray
    hot: np.ndarray

    @classmethod
    def drawn(
        cls, camera: Camera, shape: tuple[int, int], photons_per_pixel: float, rng: np.random.Generator
    ) -> Sensor:
        """A sensor of `shape` (H, W) pixels drawn at random; `InputError` where no gain fits (see `Camera.gain`)."""
        mean = camera.gain_for(photons_per_pixel)
        require(mean > 0, f"offset must be below {FLAT_LEVEL:.0%} of the range unless a gain is given; lower it.")
        gain = mean * np.clip(1 + camera.gain_spread * rng.standard_normal(shape), 0.05, None)
        offset = camera.offset + camera.offset_spread * rng.standard_normal(shape)
        lot = rng.uniform(size=shape)
        dead, hot = lot < camera.dead, lot >= 1 - camera.hot
        gain[dead] = 0.0
        offset[hot] = camera.most * rng.uniform(*HOT_LEVELS, int(hot.sum()))
        return cls(camera, gain, offset, dead, hot)

    @property
    def defects(self) -> np.ndarray:
        """[H, W] bool: pixels that are dead or hot."""
        return self.dead | self.hot

    def read_out(self, photons: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Counts [H, W] uint16 of a frame in which `photons` [H, W] are expected to be detected.

        The number detected is Poisson; its light is spread by the scintillator, amplified by each pixel's gain, added
        to its offset and to the read-out noise, rounded and cut off to the camera's range (Janesick 2007, *Photon
        Transfer*, chap. 2 and 3): well inside the range the variance is `gain · (mean - offset)` + read noise² + 1/12.
        """
        light = spread(rng.poisson(photons).astype(np.float64), self.camera.scintillator_px)
        counts = self.gain * light + self.offset
        if self.camera.read_noise > 0:
            counts += self.camera.read_noise * rng.standard_normal(photons.shape)
        return np.clip(np.rint(counts), 0, self.camera.most).astype(np.uint16)


def spread(image: np.ndarray, sigma_px: float) -> np.ndarray:
    """`image` [H, W] blurred by a Gaussian of standard deviation `sigma_px` [pixels], mirrored at its borders.

    By the discrete cosine transform, whose frequencies are k/2N: exact for the band-limited Gaussian, sum kept.
    """
    if sigma_px == 0:
        return image
    rows, columns = (np.exp(-2 * np.pi**2 * sigma_px**2 * (0.5 * np.arange(n) / n) ** 2) for n in image.shape)
    return np.asarray(idctn(np.asarray(dctn(image, norm="ortho")) * rows[:, None] * columns, norm="ortho"))


FAINTEST = 0.02
"""No pulse is fainter than this anywhere, relative to its mean over the frame."""
COARSEST = 8.0
"""Grains of the coarsest component, in grains of the finest."""


@checked_dataclass
class Illumination:
    """How the light of pulses varies, within a frame and from pulse to pulse."""

    energy_jitter: Share = 0.1
    """Standard deviation of the pulse energy, as a part of its mean (gamma distributed)."""
    beam_width: Positive = 0.6
    """Standard deviation of the beam's Gaussian profile, as a part of the longer side of the frame."""
    pointing: Annotated[float, Within(0, 0.3)] = 0.03
    """Standard deviation of the beam's shift along each axis, as a part of its width."""
    structure: Annotated[float, Within(0, 0.3)] = 0.15
    """Contrast (rms) of the structure that all pulses share."""
    variation: Annotated[float, Within(0, 0.3)] = 0.08
    """Contrast (rms) of the structure that changes from pulse to pulse."""
    grain_px: Positive = 3.0
    """Size (standard deviation) of the finest grains [pixels]; the coarsest are eight times larger."""
    components: Annotated[int, Within(0, 1000)] = 8
    """Number of random components that change from pulse to pulse."""
    decay: Weight = 1.0
    """Weights of component k fall off as 1/k to this power."""


@dataclass(frozen=True)
class Pulses:
    """The random draws for N pulses: energy [N], relative to the mean; weights [N, K] of the components."""

    energy: np.ndarray
    weights: np.ndarray

    def __len__(self) -> int:
        return len(self.energy)


@dataclass(frozen=True)
class PulseModel:
    """A mean and principal components of the light on a frame.

    mean: [H, W], of mean 1.
    components: [K, H, W], orthogonal, of mean square 1.
    deviations: [K] standard deviations of their weights, falling.
    energy_jitter: standard deviation of the pulse energy.
    """

    mean: np.ndarray
    components: np.ndarray
    deviations: np.ndarray
    energy_jitter: float

    @classmethod
    def drawn(cls, options: Illumination, shape: tuple[int, int], rng: np.random.Generator) -> PulseModel:
        """A model for frames of `shape` (H, W) with the statistics of `options`."""
        y, x = (np.arange(n) - 0.5 * (n - 1) for n in shape)
        width = options.beam_width * max(shape)
        profile = np.exp(-0.5 * (x**2 + y[:, None] ** 2) / width**2)
        shared = np.clip(1 + options.structure * _field(shape, options.grain_px, rng), FAINTEST, None)
        mean = profile * shared
        mean /= mean.mean()
        moved = [options.pointing * mean * (axis / width) for axis in (x, y[:, None])]  # -∂/∂shift, times its deviation
        strength = np.arange(1, options.components + 1) ** -options.decay
        strength *= options.variation / max(float(np.linalg.norm(strength)), 1e-300)
        grains = options.grain_px * np.geomspace(COARSEST, 1, max(options.components, 1))
        random = [s * mean * _field(shape, grain, rng) for s, grain in zip(strength, grains)]
        return cls(mean, *_principal(np.stack(moved + random)), options.energy_jitter)

    def pulses(self, count: int, rng: np.random.Generator) -> Pulses:
        """`count` pulses: normal weights, gamma-distributed energies (Saldin et al. 1998, Opt. Commun. 148, 383)."""
        modes = self.energy_jitter**-2 if self.energy_jitter > 0 else np.inf
        energy = rng.gamma(modes, 1 / modes, count) if np.isfinite(modes) else np.ones(count)
        return Pulses(energy, self.deviations * rng.standard_normal((count, len(self.deviations))))

    def light(self, pulses: Pulses, number: int) -> np.ndarray:
        """The light [H, W] of the pulse `number`, relative to the mean over pulses and frame."""
        pattern = self.mean + np.tensordot(pulses.weights[number], self.components, 1)
        return pulses.energy[number] * np.clip(pattern, FAINTEST, None)


def _field(shape: tuple[int, int], grain_px: float, rng: np.random.Generator) -> np.ndarray:
    """A Gaussian random field [H, W] of mean 0 and mean square 1, correlated over `grain_px`."""
    field = spread(rng.standard_normal(shape), grain_px)
    field -= field.mean()
    return field / max(float(np.sqrt((field**2).mean())), 1e-300)


def _principal(fields: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Orthogonal components [K, H, W] of mean square 1, and deviations [K], with the covariance of Σ normal · field."""
    flat = fields.reshape(len(fields), -1)
    values, vectors = np.linalg.eigh(flat @ flat.T / flat.shape[1])
    order = [i for i in np.argsort(-values) if values[i] > 1e-12 * max(values.max(), 1e-300)]
    deviations = np.sqrt(values[order])
    components = (vectors[:, order] / deviations).T @ flat
    return components.reshape(-1, *fields.shape[1:]), deviations
