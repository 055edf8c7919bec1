"""Light that is not what the flat field says: it differs from frame to frame, is uneven, grainy, and drifts.

A frame divided by its flat is `I (1 + o) (1 + s·x + b + g) L(x - d) / L(x)`: of relative intensity I, an offset
o, slopes s, a smooth background b and correlated grain g, all new in each frame, and a pattern L that the flat holds
where it was and the frame where it has drifted to. Photons see the light: counts are Poisson with the mean that
arrives, and the division by the flat comes after.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Annotated

import numpy as np

from ..checks import require
from ..ranges import Seed, Within, checked_dataclass

MOST_RMS = 0.2
"""Largest relative deviation of light (rms): beyond, one in a million pixels would have to be dark."""
Uneven = Annotated[float, Within(0, MOST_RMS)]
Grain = Annotated[float, Within(0.3, 1e4, unit="pixels")]
"""Correlation lengths [pixels]."""
FAINTEST = 0.01
"""No pixel gets less than this share of the light."""


@checked_dataclass
class UnevenLight:
    """How light differs from the flat field; by default not at all. Errors: `InputError` for values out of range."""

    light_flux: Annotated[float, Within(0.01, 100)] = 1.0
    """Mean intensity of the air, relative to the flat."""
    light_offset: Uneven = 0.0
    """Relative deviation (rms) of each frame's own intensity from that."""
    light_slope: Uneven = 0.0
    """Relative change (rms) of each frame's intensity from its middle to an edge, along rows and along columns."""
    light_smooth: Uneven = 0.0
    """Relative deviation (rms) of a smooth random background, another in each frame."""
    light_smooth_px: Grain = 30.0
    """Correlation length of the smooth background [pixels]: its correlation is exp(-r² / 2 length²)."""
    light_grain: Uneven = 0.0
    """Relative deviation (rms) of correlated grain, another in each frame."""
    light_grain_px: Grain = 1.5
    """Correlation length of the grain [pixels]."""
    light_pattern: Uneven = 0.0
    """Relative deviation (rms) of the pattern that all frames and the flat share."""
    light_pattern_px: Grain = 15.0
    """Correlation length of the pattern [pixels]."""
    light_drift_px: Annotated[float, Within(-1e4, 1e4)] = 0.0
    """How far the pattern moves sideways, along rows, from the flat and the first frame to the last [pixels]."""
    light_seed: Seed = 0
    """Seed of the light."""

    def __post_init__(self) -> None:
        require(
            self.light_drift_px == 0 or self.light_pattern > 0,
            "light_drift_px moves the pattern, of which there is none; give light_pattern, too.",
        )

    @property
    def is_even(self) -> bool:
        """Whether the light is as the flat says."""
        used = (self.light_offset, self.light_slope, self.light_smooth, self.light_grain, self.light_pattern)
        return self.light_flux == 1 and not any(used)

    def facts(self) -> dict[str, str]:
        """The entries of a scan file's provenance: what differs from even light."""
        return {f.name: f"{getattr(self, f.name):g}" for f in fields(self) if getattr(self, f.name) != f.default}

    def on(self, count: int, shape: tuple[int, int]) -> Lamp:
        """The light on `count` frames of `shape` (H, W), drawn by the seed."""
        rng = np.random.default_rng([self.light_seed, 0])
        pattern = np.ones(shape)
        if self.light_pattern > 0:
            margin = int(np.ceil(abs(self.light_drift_px)))
            wide = (shape[0], shape[1] + 2 * margin)
            pattern = 1 + self.light_pattern * correlated_field(wide, self.light_pattern_px, rng)
        return Lamp(self, count, shape, np.maximum(pattern, FAINTEST))


EVEN_LIGHT = UnevenLight()
"""Light as the flat field says."""


@dataclass(frozen=True, eq=False)
class Lamp:
    """The light on the frames of one scan.

    how: what it is drawn from; count: frames; shape: (H, W); pattern: [H, W + 2 margin], with room for its drift.
    """

    how: UnevenLight
    count: int
    shape: tuple[int, int]
    pattern: np.ndarray

    @property
    def flat(self) -> np.ndarray:
        """The light [H, W] of the flat field, of mean about 1."""
        return self._pattern(0.0)

    def arriving(self, frame: int) -> np.ndarray:
        """The light [H, W] of frame number `frame`, in units of the mean flat."""
        how, (h, w) = self.how, self.shape
        offset, down, across = np.random.default_rng([how.light_seed, 1, frame]).normal(size=3)
        y, x = (2 * (np.arange(n) + 0.5) / n - 1 for n in (h, w))
        uneven = 1 + how.light_slope * (down * y[:, None] + across * x)
        fields = ((how.light_smooth, how.light_smooth_px), (how.light_grain, how.light_grain_px))
        for kind, (rms, length) in enumerate(fields, start=2):
            if rms > 0:
                rng = np.random.default_rng([how.light_seed, kind, frame])
                uneven += rms * correlated_field(self.shape, length, rng)
        gone = how.light_drift_px * frame / max(self.count - 1, 1)
        light = how.light_flux * (1 + how.light_offset * offset) * uneven * self._pattern(gone)
        return np.maximum(light, FAINTEST * how.light_flux)

    def recorded(
        self, intensity: np.ndarray, frame: int, photons: float | None = None, rng: np.random.Generator | None = None
    ) -> np.ndarray:
        """A frame [H, W] divided by the flat: of relative `intensity`, with photon noise where `photons` are given.

        photons: mean counts a pixel in the flat, which is itself free of noise; rng: draws the noise.
        """
        arrived, flat = intensity * self.arriving(frame), self.flat
        if photons is None:
            return arrived / flat
        rng = np.random.default_rng() if rng is None else rng
        return rng.poisson(np.clip(arrived, 0, None) * photons) / (photons * flat)

    def _pattern(self, gone: float) -> np.ndarray:
        """The pattern [H, W] after it moved by `gone` pixels to the right, between pixels by linear interpolation."""
        w, margin = self.shape[1], (self.pattern.shape[1] - self.shape[1]) // 2
        if margin == 0:
            return self.pattern
        at = margin + np.arange(w) - gone
        low = np.clip(np.floor(at).astype(int), 0, self.pattern.shape[1] - 2)
        part = at - low
        return (1 - part) * self.pattern[:, low] + part * self.pattern[:, low + 1]


def correlated_field(shape: tuple[int, int], length_px: float, rng: np.random.Generator) -> np.ndarray:
    """A Gaussian random field [H, W] of mean 0 and variance 1 whose correlation is `exp(-r² / 2 length²)`, in pixels.

    White noise under a Gaussian window of the standard deviation `length / √2`, on a raster six lengths larger, whose
    edges wrap around.
    """
    extra = int(np.ceil(6 * length_px))
    large = tuple(n + min(extra, 4 * n) for n in shape)
    fy, fx = np.fft.fftfreq(large[0]), np.fft.rfftfreq(large[1])
    window = np.exp(-(np.pi**2) * length_px**2 * (fy[:, None] ** 2 + fx**2))
    full = np.exp(-2 * np.pi**2 * length_px**2 * (fy[:, None] ** 2 + np.fft.fftfreq(large[1]) ** 2))
    noise = np.fft.rfft2(rng.normal(size=large))
    field = np.fft.irfft2(noise * window, s=large) / np.sqrt(full.mean())
    return field[: shape[0], : shape[1]]
