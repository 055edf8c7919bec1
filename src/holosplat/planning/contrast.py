"""The contrast of one object in one frame, and its detectability in photon noise.

The frame is that of `model.Instrument` in float64 on a raster of its own, made for the object: fine enough for the
fringes and the object, wide enough for the reach of the fringes, and blurred by the pixel in Fourier space. It gives
the frame for every position of the object on the detector's pixels.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated

import numpy as np

from ..checks import finite, in_range, require
from ..geometry import Views
from ..matter import DeltaBeta
from ..mesh import TriangleMesh
from ..ranges import Metres, Positive, Share, Small, Within, checked_dataclass
from ..scan import ENERGY_RANGE_KEV, PIXEL_RANGE_M, Exposures, checked_distance
from ..units import wavelength, wavenumber

if TYPE_CHECKING:
    from ..materials import Material

FINE, COARSE = (8, 32), (4, 16)
"""Samples on the first fringe's width √(λz), and across the object. SNR² of a red cell is then right to 1 % or 2 %;
where fringes are so wide that `COARSE` is taken, it costs no more than another 1 %."""
SAMPLES_A_PIXEL = 16
"""Finer than this the raster need not be: fringes far narrower than a pixel hardly change a pixel's mean."""
COMFORTABLE, MOST_SAMPLES = 640, 2048
"""Samples along the raster's edge: up to the first it is `FINE`, beyond the second there is no frame."""
SPREAD = 0.9
"""The part of SNR² within `Visibility.spread`."""


@dataclass(frozen=True)
class Subject:
    """The object of a plan: a closed mesh [m] as it lies in the beam (along z), of one material in a medium (None:
    vacuum)."""

    mesh: TriangleMesh
    material: Material
    medium: Material | None = None

    def __post_init__(self) -> None:
        low, high = self.mesh.bounds
        centred = self.mesh.transformed(np.eye(3), -0.5 * (low + high))
        require(bool(np.all(high > low)), f"{self.mesh.name} must have an extent along x, y and z; it is flat.")
        object.__setattr__(self, "mesh", centred)

    @property
    def extent(self) -> np.ndarray:
        """Size along `(x, y, z)` [m]."""
        low, high = self.mesh.bounds
        return high - low

    @property
    def diameter(self) -> float:
        """The larger extent across the beam [m]."""
        return float(self.extent[:2].max())

    def tilted(self, degrees: float) -> Subject:
        """The object turned by `degrees` about x, an axis across the beam."""
        finite("tilt", np.array(degrees))
        c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
        return replace(self, mesh=self.mesh.transformed(np.array([[1, 0, 0], [0, c, -s], [0, s, c]]), np.zeros(3)))

    def contrast(self, energy_kev: float) -> DeltaBeta:
        """Differences Δδ and Δβ between the object and its medium, at `energy_kev` [keV]."""
        inside = self.material.delta_beta(energy_kev)
        added = inside.against(self.medium.delta_beta(energy_kev)) if self.medium else inside
        require(
            added != DeltaBeta(0.0, 0.0),
            "the object and its medium must differ, but they are the same material; nothing would be seen.",
        )
        return added


@checked_dataclass
class Setup:
    """The beam and the detector of one frame."""

    energy_kev: Positive = 20.0
    """Photon energy [keV]."""
    distance: Metres = 0.1
    """Effective propagation distance, in the sample plane [m]; 0: in contact."""
    pixel_size: Small = 3.2e-6
    """Effective pixel size, in the sample plane [m]."""
    psf_sigma_px: Annotated[float, Within(0, 1000, unit="pixels")] = 0.0
    """Standard deviation of the detector's Gaussian point-spread function [pixels]."""
    source_angle: Share = 0.0
    """Standard deviation of the Gaussian source, seen from the object [rad]; times the distance it is the blur."""

    def __post_init__(self) -> None:
        in_range("energy", self.energy_kev, *ENERGY_RANGE_KEV, unit="keV")
        checked_distance(self.distance)
        in_range("pixel size", self.pixel_size, *PIXEL_RANGE_M, unit="metres")

    @property
    def fringe(self) -> float:
        """Width of the first Fresnel fringe, √(λz) [m]."""
        return math.sqrt(wavelength(self.energy_kev) * self.distance)

    @property
    def blur_px(self) -> float:
        """Standard deviation of detector and source together [pixels]."""
        return math.hypot(self.psf_sigma_px, self.source_angle * self.distance / self.pixel_size)

    def fresnel_number(self, radius: float) -> float:
        """Fresnel number a²/(λz) of a half-width `radius` [m] (Goodman 2005, *Fourier Optics*, sect. 4.5.1); infinite
        in contact."""
        return (radius / self.fringe) ** 2 if self.fringe else math.inf


@dataclass(frozen=True)
class Visibility:
    """One object in one frame.

    phase: largest phase shift k |Δδ| T [rad].
    absorption: largest loss of intensity 1 - exp(-2 k Δβ T), negative where the object absorbs less than its medium.
    lowest, highest: extremes of the contrast `I - 1` that a pixel can see.
    rms: root mean square of the contrast over the object's shadow.
    spread: diameter [m] of the circle about the object's centre that holds 90 % of SNR².
    information: [f, f] SNR² at one photon a pixel, for f × f places (y, x) of the object on the pixels, evenly spread
        over one pixel.
    middle: [n, n] contrast of the pixels with the object's centre on the corner of four.
    """

    phase: float
    absorption: float
    lowest: float
    highest: float
    rms: float
    spread: float
    information: np.ndarray
    middle: np.ndarray

    @property
    def information_in_the_middle(self) -> float:
        """SNR² at one photon a pixel, the object's centre on the corner of four pixels (an even detector's middle)."""
        place = _middle(len(self.information))
        return float(self.information[place, place])


def signal_to_noise_squared(contrast: np.ndarray) -> np.ndarray:
    """Contributions of pixels of `contrast` c = I - 1 [...] to the squared signal to noise, at one photon a pixel:
    [...].

    The optimal linear filter's (Hotelling's) `SNR² = Σ Δ² / v`, with Δ the difference of the mean counts with and
    without the object, and v the mean of their two variances (Barrett & Myers 2004, *Foundations of Image Science*,
    chap. 13). Counts are Poisson, of mean N and N (1 + c), so `SNR² = N Σ c² / (1 + c/2)`. For weak contrast that is
    North's matched filter in white noise, N Σ c² (North 1943, reprinted in Proc. IEEE 51, 1016, 1963). The filter,
    c / (1 + c/2), is ln(1 + c) to second order, which is the likelihood-ratio test of Poisson counts.
    """
    return contrast**2 / np.maximum(1 + 0.5 * contrast, 0.5)  # 1 + c is an intensity: below 0 it is rounding


def visibility(subject: Subject, setup: Setup) -> Visibility:
    """The contrast of `subject` in a frame taken with `setup`; `InputError` if its fringes reach too far to compute."""
    raster = _raster(subject, setup)
    added = subject.contrast(setup.energy_kev)
    thickness, intensity = _frame(subject, setup, added, raster)
    # The pixel about each sample averages by its transfer function `sinc(p fx) sinc(p fy)`.
    frequencies = np.fft.fftfreq(raster.count), np.fft.rfftfreq(raster.count)
    rows, columns = (np.sinc(raster.factor * f) for f in frequencies)
    contrast = np.fft.irfft2(np.fft.rfft2(intensity - 1) * rows[:, None] * columns, s=intensity.shape)
    blocks, f = raster.count // raster.factor, raster.factor
    signal = signal_to_noise_squared(contrast)
    thickest, k = float(thickness.max()), wavenumber(setup.energy_kev)
    place = _middle(f)
    return Visibility(
        phase=k * abs(added.delta) * thickest,
        absorption=-math.expm1(-2 * k * added.beta * thickest),
        lowest=float(contrast.min()),
        highest=float(contrast.max()),
        rms=float(np.sqrt(np.mean(contrast[thickness > 0] ** 2))),
        spread=_spread(signal, raster.pitch),
        information=signal.reshape(blocks, f, blocks, f).sum(axis=(0, 2)),
        middle=contrast[place::f, place::f],
    )


@dataclass(frozen=True)
class _Raster:
    """`count × count` samples of `pitch` [m], `factor` along a pixel's edge; count is a multiple of 2 factor."""

    factor: int
    count: int
    pitch: float


def _raster(subject: Subject, setup: Setup) -> _Raster:
    """The raster for one object; see the constants above."""
    raster = _raster_of(subject, setup, FINE)
    if raster.count > COMFORTABLE:
        raster = _raster_of(subject, setup, COARSE)
    require(
        raster.count <= MOST_SAMPLES,
        f"one object and its fringes must fit into {MOST_SAMPLES} samples, but at {setup.distance:g} m and "
        f"{setup.energy_kev:g} keV they need {raster.count}; take a shorter distance, larger pixels or a smaller "
        "object.",
    )
    return raster


def _raster_of(subject: Subject, setup: Setup, samples: tuple[int, int]) -> _Raster:
    fringe, pixel, narrow = setup.fringe, setup.pixel_size, float(subject.extent[:2].min())
    wanted = min(fringe / samples[0], narrow / samples[1])
    finest = min(pixel / SAMPLES_A_PIXEL, narrow / samples[1])
    factor = math.ceil(pixel / max(wanted, finest))
    # Detail of frequency f travels sideways by λ z f. Beyond 4 / width the object has little detail left; short
    # of 2 / √(λz) it travels less than two fringes; and beyond 1 / pixel no detail is seen.
    frequency = min(1 / pixel, max(4 / narrow, 2 / fringe if fringe else math.inf))
    half = 0.5 * subject.diameter + fringe**2 * frequency + (4 + 4 * setup.blur_px) * pixel
    return _Raster(factor, 2 * factor * math.ceil(half / pixel), pixel / factor)


def _frame(subject: Subject, setup: Setup, added: DeltaBeta, raster: _Raster) -> tuple[np.ndarray, np.ndarray]:
    """The object's thickness [m] and the intensity behind it at the raster's samples, both [count, count]."""
    import torch  # which takes long to load, and the options of a plan do without

    from ..model import Instrument
    from ..specimens.scene import MeshScene
    from ..volume import LineIntegrals

    shift = 0.5 * raster.pitch if raster.factor % 2 == 0 else 0.0  # a sample lies on each pixel's centre
    shape = (raster.count, raster.count)
    views = Views(np.eye(3)[None], np.full((1, 2), shift), shape, raster.pitch)
    sigma = setup.blur_px * raster.factor
    instrument = Instrument(Exposures.of(views, setup.energy_kev, setup.distance, sigma), 1, torch.float64)
    _, depth = MeshScene((subject.mesh,), (DeltaBeta(1.0, 0.0),)).project(instrument.views)
    intensity = instrument.frames(LineIntegrals(depth[:, None], ((added.delta, added.beta),)))[0].numpy()
    my, mx = instrument.margin
    return depth[0, my : my + raster.count, mx : mx + raster.count].numpy(), intensity


def _spread(signal: np.ndarray, pitch: float) -> float:
    """Diameter [m] of the circle about the middle of `signal` [n, n] that holds `SPREAD` of its sum."""
    at = np.arange(len(signal)) - 0.5 * (len(signal) - 1)
    radius = np.hypot(at[:, None], at).reshape(-1)
    order = np.argsort(radius)
    inside = np.cumsum(signal.reshape(-1)[order])
    return 2 * pitch * float(radius[order][np.searchsorted(inside, SPREAD * inside[-1])])


def _middle(factor: int) -> int:
    """Which of `factor` places along a pixel has the object's centre on the pixel's edge (see `_frame`)."""
    return (factor + 1) // 2 - 1
