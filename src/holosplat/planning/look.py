"""A look at a few frames of a scan: level of the air, noise, contrast and fringes."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch

from ..frames import binned
from ..optics.air import find_air
from ..optics.noise import noise_levels
from ..units import in_percent, two_digits

LOOKED = 3
"""Frames that are read: the first, the one in the middle, and the last."""
MOST_PIXELS = 1024
"""Rows and columns of the middle of a frame whose noise and spectrum are measured: a larger frame has no other."""
AIR_PIXELS = 512
"""Rows and columns on which air is looked for: it is found in binned frames as well."""
ABOVE = 2.0
"""Times the noise's power from which on frames show structure."""
NOISELESS = 0.02
"""Noise, as a share of the contrast, below which frames count as free of noise, as in the verdict on a run."""


@dataclass(frozen=True)
class Spectrum:
    """Power of frames [B] at frequencies [B] in cycles a pixel, and that of white noise as strong as theirs."""

    frequency: np.ndarray
    power: np.ndarray
    noise: float

    @property
    def finest(self) -> float | None:
        """The shortest period [pixels] whose power is above the noise; None where none is."""
        above = np.flatnonzero(self.power > ABOVE * self.noise)
        return 1 / float(self.frequency[above[-1]]) if len(above) else None


@dataclass(frozen=True)
class Look:
    """Properties of K frames. frames: [K, H, W] as read; air: mean of what passes for air, None where there is
    none, and `air_share` of the frames; level: what counts as one; noise, contrast: standard deviation and root mean
    square of relative intensity less one; least, most: of all but a thousandth of the pixels."""

    frames: np.ndarray
    air: float | None
    air_share: float
    level: float
    noise: float
    contrast: float
    least: float
    most: float
    spectrum: Spectrum

    @property
    def is_light(self) -> bool:
        """Whether the values can be intensities, which are above 0 but for noise."""
        return self.level > 0 and self.least > -self.level

    def rows(self) -> dict[str, str]:
        """The same in words, by name."""
        if not self.is_light:
            return {"values": f"{_number(self.least)} to {_number(self.most)}, which are no intensities"}
        air = (
            f"{_number(self.air)} in {in_percent(self.air_share)} of the frames"
            if self.air is not None
            else ("none is found: fringes or matter fill the frames")
        )
        share = self.noise / self.contrast if self.contrast > 0 else 0.0
        seen = f"{in_percent(self.noise)} of the level" + (f", {in_percent(share)} of the contrast" if share else "")
        span = f"rms {in_percent(self.contrast)}, values {_number(self.least)} to {_number(self.most)}"
        noise = seen if share > NOISELESS else "none is seen" + (f" beyond {seen}" if self.noise > 0 else "")
        return {"air level": air, "noise": noise, "contrast": span}

    def fringes(self, widths: np.ndarray) -> str:
        """Describe first fringes of such `widths` √(λz) [pixels], and of the finest detail above the noise."""
        low, high = (f"{two_digits(float(each))}" for each in (widths.min(), widths.max()))
        finest = self.spectrum.finest
        said = (
            "the contrast is below the noise"
            if finest is None
            else (f"contrast is above the noise down to periods of {two_digits(finest)} pixels")
        )
        width = low if low == high else f"{low} to {high}"
        return f"first fringe √(λz) {width} pixels; {said}" if widths.any() else f"none in contact; {said}"


def looked(frames: np.ndarray) -> Look:
    """Measure `frames` [K, H, W], relative to their air, or else to their median."""
    factor = max(1, math.ceil(max(frames.shape[1:]) / AIR_PIXELS))
    factor = min(factor, *frames.shape[1:])
    small = torch.from_numpy(binned(frames, factor))
    air = find_air(small)
    level = float(small[air].mean()) if bool(air.any()) else float(small.median())
    tops = [max(0, (n - MOST_PIXELS) // 2) for n in frames.shape[1:]]
    rows, columns = (slice(top, top + MOST_PIXELS) for top in tops)
    part = torch.from_numpy(frames[:, rows, columns] / np.float32(level if level > 0 else 1.0))
    noise = float(noise_levels(part).mean())
    contrast = float((part.double() - 1).square().mean().sqrt())
    least, most = np.quantile(small.numpy(), (0.001, 0.999))
    found = level if bool(air.any()) else None
    shown = _spectrum(part.double().numpy() - 1, noise)
    return Look(frames, found, float(air.double().mean()), level, noise, contrast, float(least), float(most), shown)


def _spectrum(contrast: np.ndarray, noise: float) -> Spectrum:
    """The mean power of `contrast` [K, H, W] in rings of frequency, under a Hann window, in units of a sample's."""
    h, w = contrast.shape[1:]
    window = np.outer(np.hanning(h + 2)[1:-1], np.hanning(w + 2)[1:-1])
    power = np.mean(np.abs(np.fft.rfft2((contrast - contrast.mean()) * window)) ** 2, axis=0) / np.sum(window**2)
    frequency = np.hypot(np.fft.fftfreq(h)[:, None], np.fft.rfftfreq(w))
    count = max(2, max(h, w) // 2)
    ring = np.minimum((frequency * 2 * count).astype(int), count)
    sums, counts = (np.bincount(ring.ravel(), values, count + 1)[1:count] for values in (power.ravel(), None))
    there = counts > 0  # frames of few rows have few frequencies
    at = (np.arange(1, count) + 0.5) / (2 * count)
    return Spectrum(at[there], sums[there] / counts[there], noise**2)


def _number(value: float) -> str:
    return f"{value:.4g}"
