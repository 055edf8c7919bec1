"""From photons to counts: an integrating camera with a scintillator."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.fft import dctn, idctn

from ..checks import in_range, positive, require
from ..ranges import Pixels, Positive, Weight, checked_dataclass

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

    bits: int = 12
    """Bits of a count (10 to 16); brighter pixels are saturated."""
    gain: Positive | None = None
    """Counts a detected photon gives (default: such that a mean flat fills 40 % of the range)."""
    offset: float = 100.0
    """Counts without light."""
    read_noise: Weight = 2.0
    """Standard deviation of the read-out noise [counts]."""
    gain_spread: float = 0.02
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
        low, high = BITS
        whole = isinstance(self.bits, int) and low <= self.bits <= high
        require(whole, f"bits must be a whole number from {low} to {high}, but it is {self.bits}.")
        if self.gain is not None:
            in_range("gain", self.gain, *GAINS, unit="counts a photon")
        require(
            self.offset < self.most, f"offset must be below the range of {self.most} counts, but it is {self.offset}."
        )
        require(self.gain_spread <= 0.3, f"gain_spread must be at most 0.3, but it is {self.gain_spread}.")
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
