"""Light that is not one plane wave: sources of finite size and distance, and spectra of finite width."""

from __future__ import annotations

import math
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np

from ..checks import finite, in_range, require, shaped
from ..scan import DISTANCE_RANGE_M, ENERGY_RANGE_KEV, MOST_BANDWIDTH, PIXEL_RANGE_M, Exposures
from ..units import wavelength

SOURCE_RANGE_M = (1e-9, 1e-1)
SOURCE_DISTANCE_RANGE_M = (1e-6, 1e5)
FWHM = 2 * math.sqrt(2 * math.log(2))
"""Full width at half maximum of a Gaussian of standard deviation 1."""
QUADRATURE = 1e-3
"""Error of the contrast of the finest fringes, as a share of it, that a sum over energies may have."""
TAILS, ALIASED = -NormalDist().inv_cdf(QUADRATURE / 8), math.sqrt(-2 * math.log(QUADRATURE / 2))
"""Standard deviations beyond which a normal distribution has a quarter of `QUADRATURE`, and where `exp(-x²/2)` is half
of it: together they err by that much, as what is left out counts twice."""
MOST_ENERGIES = 32
"""Energies of a spectrum in a fit at most: each costs the waves of a frame."""


@dataclass(frozen=True)
class Spectrum:
    """Photon energies and the share of the detected light at each, as an incoherent sum takes them.

    energies_kev: [E] photon energies [keV].
    weights: [E] shares, not negative; they are scaled to the sum 1.
    """

    energies_kev: np.ndarray
    weights: np.ndarray

    def __post_init__(self) -> None:
        energies = shaped("spectrum energies", np.asarray(self.energies_kev, dtype=np.float64), (None,))
        require(len(energies) > 0, "a spectrum must hold at least one energy, but it is empty.")
        weights = np.asarray(self.weights, dtype=np.float64)
        weights = finite("spectrum weights", shaped("spectrum weights", weights, (len(energies),)))
        for energy in energies:
            in_range("spectrum energy", float(energy), *ENERGY_RANGE_KEV, unit="keV")
        good = bool(np.all(weights >= 0)) and weights.sum() > 0
        require(good, "spectrum weights must not be negative, nor all zero; correct them.")
        object.__setattr__(self, "energies_kev", energies[weights > 0])
        object.__setattr__(self, "weights", weights[weights > 0] / weights.sum())

    @classmethod
    def gaussian(cls, energy_kev: float, bandwidth: float, count: int = 7) -> Spectrum:
        """A Gaussian about `energy_kev` [keV] of the relative full width at half maximum `bandwidth` (ΔE/E).

        `count` energies at the nodes of Gauss–Hermite quadrature (Abramowitz & Stegun 1964, eq. 25.4.46): exact for
        frames that are polynomials of degree `2 count - 1` in the energy.
        """
        require(count >= 1, f"the number of energies must be at least 1, but it is {count}.")
        width = in_range("bandwidth", bandwidth, 1e-8, MOST_BANDWIDTH) / FWHM
        nodes, weights = np.polynomial.hermite.hermgauss(count)
        return cls(energy_kev * (1 + math.sqrt(2) * width * nodes), weights)

    @property
    def mean_kev(self) -> float:
        """The mean energy [keV]."""
        return float(self.weights @ self.energies_kev)

    def __len__(self) -> int:
        return len(self.weights)


def quadrature(exposures: Exposures) -> tuple[np.ndarray, np.ndarray]:
    """Nodes [E] and weights [E] of a sum over the energies `E₀ (1 + node · bandwidth)` of the light of all frames.

    Fringes of the frequency f vary with the energy as cos(χE₀/E), χ = πλz f², by χσ over a Gaussian of relative
    standard deviation σ; χ is taken at the corner of the detector's spectrum. The rule of fewer energies is taken:

    - Gauss–Hermite quadrature (Abramowitz & Stegun 1964, eq. 25.4.46), whose remainder of n nodes is `(χσ)²ⁿ n!/(2n)!`
      at most, so that n grows as (χσ)²;
    - equal steps h over ±Sσ, with `exp(-(2π/h - a)²/2)` at most, a being the most that a fringe varies by there,
      `χσ/(1 - Sσ)²`, besides what lies beyond (Trefethen & Weideman 2014, SIAM Rev. 56, 385, theorem 5.1, on a line
      that is moved by 2π/h - a); n grows as χσ. It needs fewer where the bandwidth washes fringes out.

    Both err by `QUADRATURE` at most; the first one where χE₀/E is as good as linear in the energy. One node of weight 1
    where all frames have one energy. Errors: `InputError` where more than `MOST_ENERGIES` would be needed.
    """
    optics = exposures.optical
    reach = wavelength(optics.energy_kev) * np.abs(optics.distance)
    wide = float(np.max(optics.bandwidth, initial=0.0)) / FWHM
    worst = float(np.max(math.pi * reach / (2 * optics.views.pitch**2) * optics.bandwidth / FWHM, initial=0.0))
    count, error = 1, worst**2 / 2
    while error > QUADRATURE and count <= MOST_ENERGIES:
        count += 1
        error *= worst**2 / (2 * (2 * count - 1))
    even = math.ceil(TAILS / math.pi * (worst / (1 - TAILS * wide) ** 2 + ALIASED))
    if count <= min(even, MOST_ENERGIES) and math.sqrt(4 * count + 2) * wide < 1:
        nodes, weights = np.polynomial.hermite.hermgauss(count)
        return math.sqrt(2) / FWHM * nodes, weights / weights.sum()
    require(
        even <= MOST_ENERGIES,
        f"a bandwidth of {wide * FWHM:g} washes out the finest fringes of these pixels and distances, which takes "
        f"more than {MOST_ENERGIES} energies ({even}); bin the frames (--bin), or give a narrower --bandwidth.",
    )
    nodes = TAILS * (2 * np.arange(even) + 1 - even) / even
    weights = np.exp(-0.5 * nodes**2)
    return nodes / FWHM, weights / weights.sum()


def source_blur(source_size: float, source_distance: float, distance: float | np.ndarray) -> np.ndarray:
    """Standard deviation [m], in the sample plane, of the blur by a Gaussian source.

    source_size: standard deviation of the source [m]; source_distance: from source to sample [m]; distance: effective
    propagation distance(s) [m]. An incoherent source blurs a frame by its image through each point of the sample
    (Van Cittert–Zernike theorem; Goodman 1985, *Statistical Optics*, sect. 5.6): by `σ z₂/z₁` on the detector, which
    is `σ z_eff/z₁` in the sample plane, since `z_eff = z₂/M`. Gaussian blurs add in quadrature, so this one joins the
    point-spread function without loss.
    """
    size = in_range("source size", source_size, *SOURCE_RANGE_M, unit="metres")
    z1 = in_range("source distance", source_distance, *SOURCE_DISTANCE_RANGE_M, unit="metres")
    return size * np.asarray(distance, dtype=np.float64) / z1


def joined_blur_px(
    psf_sigma_px: float | np.ndarray, blur: float | np.ndarray, pixel_size: float | np.ndarray
) -> np.ndarray:
    """Standard deviation [pixels] of the point-spread function and another Gaussian `blur` [m] together."""
    return np.hypot(psf_sigma_px, np.asarray(blur) / pixel_size)


@dataclass(frozen=True)
class EffectiveGeometry:
    """The parallel beam that gives the same frames as a cone.

    magnification: M.
    distance: effective propagation distance [m].
    pixel_size: effective pixel [m].
    """

    magnification: float
    distance: float
    pixel_size: float


def effective_geometry(source_distance: float, detector_distance: float, detector_pixel: float) -> EffectiveGeometry:
    """The parallel beam equivalent to a cone beam, by the Fresnel scaling theorem (Paganin 2006, *Coherent X-Ray
    Optics*, app. B).

    source_distance: source to sample z₁ [m]; detector_distance: sample to detector z₂ [m]; detector_pixel: the
    detector's own pixel [m]. `M = (z₁ + z₂)/z₁`, distance `z₂/M`, pixel `p/M`; intensities are relative to the flat.
    """
    z1 = in_range("source distance", source_distance, *SOURCE_DISTANCE_RANGE_M, unit="metres")
    z2 = in_range("detector distance", detector_distance, *DISTANCE_RANGE_M, unit="metres")
    pixel = in_range("detector pixel", detector_pixel, *PIXEL_RANGE_M, unit="metres")
    magnification = 1 + z2 / z1
    return EffectiveGeometry(magnification, z2 / magnification, pixel / magnification)
