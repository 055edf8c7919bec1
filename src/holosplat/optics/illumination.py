"""Pulses of a free-electron laser: each of its own energy, place and structure, drawn from a low-rank model.

Flat fields of such sources are a mean and a few principal components with random weights (Buakor et al. 2022, Opt.
Express 30, 10633; Birnsteinova et al. 2023, J. Synchrotron Rad. 30, 1030). Here the components are made, not measured:
a shift of the beam to first order, and random fields whose weights fall off as a power of their number.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..checks import positive, require
from ..ranges import Pixels, Positive, Weight, checked_dataclass
from .camera import spread

FAINTEST = 0.02
"""No pulse is fainter than this anywhere, relative to its mean over the frame."""
COARSEST = 8.0
"""Grains of the coarsest component, in grains of the finest."""


@checked_dataclass
class Illumination:
    """How the light of pulses varies, within a frame and from pulse to pulse."""

    energy_jitter: float = 0.1
    """Standard deviation of the pulse energy, as a part of its mean (gamma distributed)."""
    beam_width: Positive = 0.6
    """Standard deviation of the beam's Gaussian profile, as a part of the longer side of the frame."""
    pointing: float = 0.03
    """Standard deviation of the beam's shift along each axis, as a part of its width."""
    structure: float = 0.15
    """Contrast (rms) of the structure that all pulses share."""
    variation: float = 0.08
    """Contrast (rms) of the structure that changes from pulse to pulse."""
    grain_px: Pixels = 3.0
    """Size (standard deviation) of the finest grains [pixels]; the coarsest are eight times larger."""
    components: int = 8
    """Number of random components that change from pulse to pulse."""
    decay: Weight = 1.0
    """Weights of component k fall off as 1/k to this power."""

    def __post_init__(self) -> None:
        positive("beam_width", self.beam_width, "the frame's longer side")
        positive("grain_px", self.grain_px, "pixels")
        for name, most in (("energy_jitter", 1.0), ("pointing", 0.3), ("structure", 0.3), ("variation", 0.3)):
            value = getattr(self, name)
            require(value <= most, f"{name} must be at most {most:g}, but it is {value:g}.")
        require(self.components <= 1000, f"components must be at most 1000, but it is {self.components}.")


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
