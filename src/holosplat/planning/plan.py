"""The plan of an experiment: contrast, resolution, motion and data, before any simulation: arithmetic on
`contrast`. `experiment` is what a simulation of it takes."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated

import numpy as np

from ..checks import in_range, require
from ..geometry import Grid, Views
from ..progress import Advance
from ..ranges import Frequency, Natural, Photons, Positive, Within, checked_dataclass
from ..scan import Exposures
from .contrast import Setup, Subject, Visibility, visibility

if TYPE_CHECKING:
    from ..specimens.scene import MeshScene

WANTED_SNR = 5.0
"""Signal to noise of a certain detection (Rose 1948, J. Opt. Soc. Am. 38, 196)."""
NEARLY = 0.9
"""The part of the best signal to noise that counts as nearly as good."""
Side = Annotated[int, Within(1, 10**6)]
"""Pixels along a side of a detector."""
BYTES_A_VOXEL = 8
"""δ and β in single precision, as volume files hold them."""


@checked_dataclass
class Recording:
    """The frames and views that are recorded."""

    photons_per_pixel: Photons = 1000.0
    """Mean photons detected in a pixel without the object."""
    views: Annotated[int, Within(1, 10**6)] = 16
    """Number of directions over 180°, recorded at the same instant."""
    detector: tuple[Side, Side] | None = None
    """(rows, columns) of a frame [pixels] (default: not given, so no field and no data rate)."""
    frame_rate: Frequency | None = None
    """Frames a second [Hz] (default: no rates are computed)."""
    exposure: Annotated[float, Within(0, 1e6, above=True, unit="seconds")] | None = None
    """Time with light in one frame, such as a pulse's length [s] (default: the whole frame)."""
    velocity: Positive | None = None
    """Velocity of the object across the beam [m/s] (default: no motion is considered)."""
    bit_depth: Annotated[int, Within(1, 64)] = 16
    """Bits stored for a pixel."""
    frames: Natural = 1
    """Number of recorded instants."""

    def __post_init__(self) -> None:
        from ..optics.noise import PHOTON_RANGE  # with torch, which takes long to load

        in_range("photons_per_pixel", self.photons_per_pixel, *PHOTON_RANGE)
        if self.frame_rate and self.exposure:
            require(
                self.exposure <= 1.000001 / self.frame_rate,
                f"exposure must fit into a frame, but {self.exposure:g} s is longer than the {1 / self.frame_rate:g} s "
                f"of one frame at {self.frame_rate:g} Hz.",
            )


@dataclass(frozen=True)
class Waves:
    """Δδ and Δβ; Fresnel numbers a²/(λz) of the object's radius and of a pixel's edge; fringe: width of the first
    fringe √(λz) [m], and in pixels; phase [rad], absorption, contrasts and spread [m] as in `Visibility`."""

    delta: float
    beta: float
    fresnel_object: float
    fresnel_pixel: float
    fringe: float
    fringe_px: float
    phase: float
    absorption: float
    contrast_low: float
    contrast_high: float
    contrast_rms: float
    spread: float


@dataclass(frozen=True)
class Detection:
    """Matched-filter signal to noise of one object in one view, and the photons a pixel that make it `WANTED_SNR`.

    snr, photons: the object in the middle of an even detector, on the corner of four pixels.
    snr_rms, photons_mean: for the mean SNR² over all places on the pixels; (worst, best) pairs are over these places.
    """

    snr: float
    snr_rms: float
    snr_worst: float
    snr_best: float
    photons: float
    photons_mean: float
    photons_worst: float
    photons_best: float


@dataclass(frozen=True)
class Sampling:
    """Crowther's limit d = π D / views [m] for views over 180° (Crowther, DeRosier & Klug 1970, Proc. R. Soc.
    Lond. A 317, 319), D being the object's or the field's width; and the views that resolve a pixel, d = p.
    Of the field: None without a detector. field: width and height [m]."""

    limit_object: float
    views_object: int
    field: tuple[float, float] | None
    limit_field: float | None
    views_field: int | None


@dataclass(frozen=True)
class Motion:
    """blur_px: path of the object during an exposure [pixels]; step_px: from one frame to the next [pixels];
    longest_exposure [s] and slowest_rate [Hz]: at which these are one pixel. None where the recording does not say."""

    blur_px: float | None
    step_px: float | None
    longest_exposure: float | None
    slowest_rate: float | None


@dataclass(frozen=True)
class Storage:
    """data_rate: of all views, packed [bytes/s]; raw: of all frames [bytes]; volume: voxels (z, y, x) of the field at
    pixel pitch; volume_bytes: its δ and β at one instant; volumes_bytes: at all. None where the recording does not say.
    """

    data_rate: float | None
    raw: float | None
    volume: tuple[int, int, int] | None
    volume_bytes: float | None
    volumes_bytes: float | None


@dataclass(frozen=True)
class Plan:
    """Contrast, resolution, motion and data of an experiment."""

    waves: Waves
    detection: Detection
    sampling: Sampling
    motion: Motion
    storage: Storage


def plan(subject: Subject, setup: Setup, recording: Recording) -> Plan:
    """Compute the contrast, resolution, motion and data rate of an experiment on one object.

    subject: the object, its material and its medium
    setup: photon energy, distance, pixel and blur
    recording: photons, views, detector, frame rate and velocity

    Errors: `InputError` if object and medium are of the same material, and for a raster too fine to compute.

    Examples:

        >>> import holosplat as hs
        >>> cell = hs.specimens.evans_fung_cell()
        >>> subject = hs.planning.Subject(cell, hs.materials.RED_CELL, hs.materials.PLASMA)
        >>> setup = hs.planning.Setup(energy_kev=20.0, distance=0.1, pixel_size=0.5e-6)
        >>> recording = hs.planning.Recording(photons_per_pixel=1000, views=4, detector=(128, 128), frame_rate=1e6)
        >>> found = hs.plan(subject, setup, recording)
        >>> print(f"SNR {found.detection.snr:.1f}, phase {found.waves.phase:.3f} rad")
        SNR 1.9, phase 0.007 rad
        >>> print(f"{found.storage.data_rate / 1e9:.0f} GB/s")
        131 GB/s
    """
    seen = visibility(subject, setup)
    return Plan(
        _waves(subject, setup, seen),
        detection(seen, recording.photons_per_pixel),
        _sampling(subject, setup, recording),
        _motion(setup, recording),
        _storage(setup, recording),
    )


def detection(seen: Visibility, photons_per_pixel: float) -> Detection:
    """Signal to noise with `photons_per_pixel`, and the photons for `WANTED_SNR`: SNR² = photons × information."""
    found = seen.information
    kinds = (seen.information_in_the_middle, float(found.mean()), float(found.min()), float(found.max()))
    snr = [math.sqrt(photons_per_pixel * kind) for kind in kinds]
    return Detection(*snr, *(_photons_for(kind) for kind in kinds))


def _photons_for(information: float) -> float:
    """Photons a pixel for `WANTED_SNR`, where one photon a pixel gives SNR² = `information`."""
    require(information > 0, "the object must leave a trace, but its contrast is zero here; nothing would be seen.")
    return WANTED_SNR**2 / information


def _waves(subject: Subject, setup: Setup, seen: Visibility) -> Waves:
    added = subject.contrast(setup.energy_kev)
    return Waves(
        *added,
        fresnel_object=setup.fresnel_number(0.5 * subject.diameter),
        fresnel_pixel=setup.fresnel_number(setup.pixel_size),
        fringe=setup.fringe,
        fringe_px=setup.fringe / setup.pixel_size,
        phase=seen.phase,
        absorption=seen.absorption,
        contrast_low=seen.lowest,
        contrast_high=seen.highest,
        contrast_rms=seen.rms,
        spread=seen.spread,
    )


def crowther_limit(diameter: float, views: int) -> float:
    """Resolution π D / views [m] of `views` over 180° of a body of `diameter` D [m]; see `Sampling`."""
    return math.pi * diameter / views


def _sampling(subject: Subject, setup: Setup, recording: Recording) -> Sampling:
    pixel, widest = setup.pixel_size, float(subject.extent.max())
    views_object = math.ceil(math.pi * widest / pixel)
    limit_object = crowther_limit(widest, recording.views)
    if recording.detector is None:
        return Sampling(limit_object, views_object, None, None, None)
    rows, columns = recording.detector
    limit_field = crowther_limit(columns * pixel, recording.views)
    field = (columns * pixel, rows * pixel)
    return Sampling(limit_object, views_object, field, limit_field, math.ceil(math.pi * columns))


def _motion(setup: Setup, recording: Recording) -> Motion:
    if recording.velocity is None:
        return Motion(None, None, None, None)
    pixels_a_second = recording.velocity / setup.pixel_size
    rate = recording.frame_rate
    time = recording.exposure or (1 / rate if rate else None)  # with light in one frame
    blur = None if time is None else pixels_a_second * time
    step = None if rate is None else pixels_a_second / rate
    return Motion(blur, step, 1 / pixels_a_second, pixels_a_second)


def _storage(setup: Setup, recording: Recording) -> Storage:
    if recording.detector is None:
        return Storage(None, None, None, None, None)
    rows, columns = recording.detector
    instant = rows * columns * recording.bit_depth / 8 * recording.views
    rate = None if recording.frame_rate is None else instant * recording.frame_rate
    shape = Grid.of_views(Views.evenly_spaced(1, (rows, columns), setup.pixel_size)).shape
    volume = float(BYTES_A_VOXEL * math.prod(shape))
    return Storage(rate, instant * recording.frames, shape, volume, volume * recording.frames)


def experiment(
    subject: Subject, setup: Setup, recording: Recording, side: int, least: int = 1
) -> tuple[MeshScene, Exposures, float]:
    """The object, its exposures and their photons a pixel, on the part of the detector that holds the object and four
    fringes at any turn about y (`least` pixels along a side), with pixels joined to `side` along the shorter side."""
    from ..specimens.scene import MeshScene  # with torch, which takes long to load

    x, y, z = subject.extent
    field = np.array([y, math.hypot(x, z)]) + 4 * setup.fringe
    wanted = np.maximum(np.ceil(field / setup.pixel_size), least)
    pixels = np.minimum(wanted, recording.detector or np.inf).astype(int)
    joined = max(1, int(pixels.min()) // side)
    rows, columns = (max(1, int(n) // joined) for n in pixels)
    views = Views.evenly_spaced(recording.views, (rows, columns), joined * setup.pixel_size)
    exposures = Exposures.of(views, setup.energy_kev, setup.distance, setup.blur_px / joined)
    scene = MeshScene.of_one_material([subject.mesh], subject.contrast(setup.energy_kev))
    return scene, exposures, recording.photons_per_pixel * joined**2


@dataclass(frozen=True)
class Survey:
    """Signal to noise over distances and energies.

    energies_kev: [E] keV.
    distances: [Z] m.
    information: [E, Z] SNR² at one photon a pixel, its mean over the places of the object on the pixels.
    spread: [E, Z] m as in `Visibility`.
    photons_per_pixel: for `snr`.
    best_frame: [n, n] contrast of the pixels at the best point.
    setup, subject: of the survey (the setup has the energy and the distance of the best point).
    """

    energies_kev: np.ndarray
    distances: np.ndarray
    information: np.ndarray
    spread: np.ndarray
    photons_per_pixel: float
    best_frame: np.ndarray
    setup: Setup
    subject: Subject

    @property
    def snr(self) -> np.ndarray:
        """Signal to noise [E, Z] with `photons_per_pixel`."""
        return np.sqrt(self.photons_per_pixel * self.information)

    @property
    def best(self) -> tuple[int, int]:
        """Where the signal to noise is greatest: index of the energy, and of the distance."""
        energy, distance = np.unravel_index(int(np.argmax(self.information)), self.information.shape)
        return int(energy), int(distance)

    def best_distances(self) -> np.ndarray:
        """Index of the best distance for each energy [E]."""
        return np.argmax(self.information, axis=1)

    def near_distances(self) -> np.ndarray:
        """Shortest distance [E] m whose signal to noise is `NEARLY` the best, for each energy (interpolated)."""
        return np.array([_reaches(self.distances, snr, NEARLY * snr.max()) for snr in self.snr])

    def table(self) -> list[dict[str, float]]:
        """One row an energy: its best distance, and the visibility there."""
        rows = []
        nearly = self.near_distances()
        for e, best in enumerate(self.best_distances()):
            energy = float(self.energies_kev[e])
            at_best = replace(self.setup, energy_kev=energy, distance=float(self.distances[best]))
            added, information = self.subject.contrast(energy), float(self.information[e, best])
            row = {
                "energy_kev": energy,
                "best_distance_m": at_best.distance,
                "distance_for_90_percent_m": float(nearly[e]),
                "snr": math.sqrt(self.photons_per_pixel * information),
                "photons_for_5": _photons_for(information),
                "spread_m": float(self.spread[e, best]),
                "fringe_px": at_best.fringe / at_best.pixel_size,
                "fresnel_object": at_best.fresnel_number(0.5 * self.subject.diameter),
                "delta": added.delta,
                "beta": added.beta,
            }
            rows.append(row)
        return rows


def _reaches(distances: np.ndarray, snr: np.ndarray, level: float) -> float:
    """The first distance [m] at which `snr` [Z] reaches `level`, straight lines between the logarithms."""
    i = int(np.argmax(snr >= level))
    if i == 0:
        return float(distances[0])
    part = math.log(level / snr[i - 1]) / math.log(snr[i] / snr[i - 1])
    return float(distances[i - 1] * (distances[i] / distances[i - 1]) ** part)


def survey(
    subject: Subject,
    setup: Setup,
    photons_per_pixel: float,
    distances: np.ndarray,
    energies_kev: np.ndarray,
    on_progress: Advance = lambda fraction: None,
) -> Survey:
    """Signal to noise of `subject` at all `distances` [Z] m and `energies_kev` [E], with the same photons a pixel,
    pixel and blur (of `setup`); `on_progress(fraction)` is called after each point."""
    from ..optics.noise import PHOTON_RANGE

    in_range("photons_per_pixel", photons_per_pixel, *PHOTON_RANGE)
    distances, energies = (np.asarray(a, dtype=np.float64).reshape(-1) for a in (distances, energies_kev))
    points = [replace(setup, energy_kev=float(e), distance=float(z)) for e in energies for z in distances]
    require(len(points) > 0, "a survey needs at least one distance and one energy.")
    information, spread = np.empty(len(points)), np.empty(len(points))
    order = np.argsort([-point.fringe for point in points])  # what cannot be computed is said at once
    for done, i in enumerate(order):
        seen = visibility(subject, points[i])
        information[i], spread[i] = seen.information.mean(), seen.spread
        on_progress((done + 1) / len(points))
    best = points[int(np.argmax(information))]
    shape = (len(energies), len(distances))
    frame = visibility(subject, best).middle
    maps = (information.reshape(shape), spread.reshape(shape))
    return Survey(energies, distances, *maps, photons_per_pixel, frame, best, subject)
