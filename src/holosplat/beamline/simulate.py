"""`simulate`: frames of an Object, on a raster fine enough for its fringes, with motion blur and photon noise, of one
energy or of a spectrum."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import torch

from ..backends import Backend, device, resolve
from ..checks import InputError, require, require_regular
from ..geometry import Grid, Views
from ..io.vtk import read_meshes
from ..materials import HAEMOGLOBIN, DeltaBeta, Material, Transparent, material_of
from ..memory import memory_kept
from ..model import Instrument, Model
from ..optics.coherence import Spectrum
from ..optics.noise import PHOTON_RANGE
from ..optics.propagation import poisson
from ..optics.sampling import resolving_oversample
from ..progress import Advance
from ..ranges import Seconds, Seed, Within, checked_dataclass
from ..scan import Exposures, Scan, interleaved_split
from ..specimens.repair import closed
from ..specimens.scene import MeshScene, MeshSeries
from ..units import LENGTH_UNITS, unit_factor, wavenumber
from ..volume import LineIntegrals, Object, Volume, mean_wave
from .light import EVEN_LIGHT, UnevenLight

SIMULATED_FRINGE_SAMPLES = 8
"""Samples on the first fringe in simulations: frames of the benchmark are then right to 1 % of their contrast (rms),
most of them to half of that (docs/data/propagation.csv); faces exactly along the beam, where the phase jumps, to 1 to
6 % (docs/data/faces.csv)."""
MOST_PULSES = 10_000


@checked_dataclass
class Shutter:
    """Length of an exposure and its flashes, each shorter than any motion.

    Errors: `InputError` for a negative length, and for one without the other.
    """

    exposure: Seconds = 0.0
    """Length of the exposure about the frame's time [s] (default: 0, no motion blur)."""
    pulses: Annotated[int, Within(1, MOST_PULSES)] = 1
    """Number of flashes, each in the middle of an equal part of the exposure; a steady beam has many."""

    def __post_init__(self) -> None:
        require(
            (self.exposure > 0) == (self.pulses > 1),
            f"motion blur needs both an exposure above 0 s and at least 2 pulses, but they are {self.exposure:g} s and "
            f"{self.pulses}; give both or neither.",
        )

    @property
    def offsets(self) -> np.ndarray:
        """When the pulses come, [pulses] seconds after the frame's time; their mean is 0."""
        return ((np.arange(self.pulses) + 0.5) / self.pulses - 0.5) * self.exposure


@checked_dataclass
class Simulation:
    """How frames are simulated.

    Errors: `InputError` for photons or a seed out of range.
    """

    photons_per_pixel: Annotated[float, Within(*PHOTON_RANGE)] | None = None
    """Mean counts of the Poisson noise (default: no noise)."""
    seed: Seed = 0
    """Seed of the noise."""
    oversample: int | None = None
    """Samples a pixel (default: as many as the fringes need, and twice as many where faces lie along the beam)."""
    shutter: Shutter = Shutter()
    """Length of an exposure (default: no motion blur)."""
    light: UnevenLight = EVEN_LIGHT
    """How the light differs from the flat field (default: not at all)."""
    backend: Backend = "cpu"
    """Where waves, and rays through meshes, are computed: cuda for a GPU (default: cpu, the same frames everywhere)."""

    def samples(self, exposures: Exposures) -> int:
        """Samples along a pixel's edge for `exposures`."""
        return self.oversample or resolving_oversample(exposures, SIMULATED_FRINGE_SAMPLES, at_least=4)

    def provenance(self, exposures: Exposures) -> dict[str, str]:
        """The entries of a scan file's provenance."""
        made_by = {
            "simulated_with_oversample": str(self.samples(exposures)),
            "photons_per_pixel": str(self.photons_per_pixel or "none"),
            "seed": str(self.seed),
        }
        shutter = {"exposure_s": f"{self.shutter.exposure:g}", "pulses": str(self.shutter.pulses)}
        return made_by | (shutter if self.shutter.pulses > 1 else {}) | self.light.facts()

    def quiet(self, exposures: Exposures) -> Simulation:
        """The same simulation of `exposures` before their light and noise."""
        return replace(self, photons_per_pixel=None, oversample=self.samples(exposures), light=EVEN_LIGHT)

    def detector(self, exposures: Exposures) -> Callable[[np.ndarray, int], np.ndarray]:
        """What turns a relative intensity [H, W] and the number of its frame into the frame, float32: the light, photon
        noise, and the division by the flat. It is to be called frame after frame."""
        noise, photons = np.random.default_rng(self.seed), self.photons_per_pixel
        lamp = None if self.light.is_even else self.light.on(len(exposures), exposures.views.shape)

        def detect(intensity: np.ndarray, frame: int) -> np.ndarray:
            if lamp is not None:
                return lamp.recorded(intensity, frame, photons, noise).astype(np.float32)
            return (intensity if photons is None else poisson(intensity, photons, noise)).astype(np.float32)

        return detect


STEEP, ALONE = 0.5, 20.0
"""A sample is the mean of the wave where the phase [rad] changes by so much between two finer ones, as at flat faces,
which may part in two there. Finer ones are asked for where it changes by twice that across the sample, and so many
times less beside: edges of round bodies change by a quarter there, and means of what is smooth would lose light."""
FINER, TILE, TOGETHER = 8, 8, 256
"""Finer samples along a sample's edge, samples along the edge of a tile, and tiles that are projected at once."""


@dataclass(frozen=True)
class _Sharp:
    """Meshes in one exposure. Where the phase jumps within a sample, as at faces along the beam, the sample is the mean
    of the wave (`mean_wave`), which differs from the wave of the mean."""

    obj: MeshScene | MeshSeries
    exposures: Exposures

    def at(self, time: float) -> _Sharp:
        """The meshes at `time` [s]."""
        return replace(self, obj=self.obj.at(time))

    def project(self, views: Views) -> tuple[torch.Tensor, torch.Tensor]:
        """(B, D) [1, H, W] [m]."""
        lines = self._lines(views)
        k, (delta, beta) = wavenumber(self.exposures.energy_kev), self.exposures.refraction(1.0, 1.0)
        k_delta, (h, w) = float((k * delta)[0]), (min(TILE, n) for n in views.shape)
        places = _tiles(_may_jump(k_delta * lines[1, 0]), h, w)
        for first in range(0, len(places), TOGETHER):
            some = places[first : first + TOGETHER]
            shifts = [views.cropped(slice(i, i + h), slice(j, j + w)).shifts for i, j in some]
            raster = replace(views[[0] * len(some)], shape=(h, w), shifts=np.concatenate(shifts)).refined(FINER)
            parts = self._lines(raster).unflatten(3, (w, FINER)).unflatten(2, (h, FINER)).movedim(3, 4)
            steps = [parts[1].diff(dim=axis).abs().amax(dim=(3, 4)) for axis in (3, 4)]
            jumps = k_delta * torch.maximum(*steps) > STEEP
            mean = mean_wave(parts.flatten(4), (k * beta).repeat(len(some)), (k * delta).repeat(len(some)))
            for n, (i, j) in enumerate(some):
                there = lines[:, 0, i : i + h, j : j + w]
                there.copy_(torch.where(jumps[n], mean[:, n], there))
        return lines[0], lines[1]

    @property
    def has_faces(self) -> bool:
        """Whether flat faces lie along the beam: whether the phase may jump within a pixel."""
        k, (delta, _) = wavenumber(self.exposures.energy_kev), self.exposures.refraction(1.0, 1.0)
        return bool(_may_jump(float((k * delta)[0]) * self._lines(self.exposures.views)[1, 0]).any())

    def _lines(self, views: Views) -> torch.Tensor:
        """B and D as one, [2, V, H, W] m."""
        lines = LineIntegrals.of_any(self.obj.project(views))
        return torch.stack((lines[0], lines[1]))

    def voxelise(self, grid: Grid) -> Volume:
        """δ and β of the meshes."""
        return self.obj.voxelise(grid)


def _may_jump(phase: torch.Tensor) -> torch.Tensor:
    """[H, W] bool, the samples within which `phase` [H, W] rad may jump along an axis."""
    found = torch.zeros_like(phase, dtype=torch.bool)
    for axis in (0, 1):
        beyond = torch.zeros_like(phase.narrow(axis, 0, 2))
        steps = torch.cat((beyond, phase.diff(dim=axis).abs_(), beyond), axis)
        first, second, third, fourth = (steps.narrow(axis, n, phase.shape[axis]) for n in range(4))
        across = second + third
        found |= (across > 2 * STEEP) & (across > ALONE * (first + fourth))
    return found


def _tiles(wanted: torch.Tensor, h: int, w: int) -> list[tuple[int, int]]:
    """First rows and columns of the tiles of h × w samples that hold those that are `wanted` [H, W]."""
    size, last = torch.tensor([h, w]), torch.tensor(wanted.shape) - torch.tensor([h, w])
    found = torch.minimum(torch.nonzero(wanted.cpu()) // size * size, last)
    return [(int(row), int(column)) for row, column in found.unique(dim=0)]


def simulated_frames(obj: Object, exposures: Exposures, how: Simulation = Simulation()) -> Iterator[np.ndarray]:
    """Simulate frames [H, W] float32 of `obj`, one by one, without keeping them.

    The optics are plain torch (their `reference`, which fits use with that backend alone), on a GPU if the backend is
    `cuda`, on a fine raster in single precision, less than 1e-5 of the contrast from double precision; meshes are
    projected by kernels that fits do not use. A frame is the average of the intensities at its pulses, with the light
    and the noise of `how`.
    """
    fine, detect, backend = how.samples(exposures), how.detector(exposures), resolve(how.backend)
    obj = obj.on(backend) if isinstance(obj, (MeshScene, MeshSeries)) else obj
    with memory_kept():
        for i in range(len(exposures)):
            one = exposures[[i]]
            meshes = _Sharp(obj, one) if isinstance(obj, MeshScene | MeshSeries) else None
            finer = 2 if meshes is not None and how.oversample is None and meshes.has_faces else 1
            instrument = Instrument(one, finer * fine, torch.float32, "reference", on=device(backend))
            model = Model(obj if meshes is None else meshes, instrument)
            frame = np.zeros(exposures.views.shape)
            for offset in how.shutter.offsets:
                frame += model.frames(delay=float(offset))[0].cpu().numpy()
            frame /= how.shutter.pulses
            yield detect(frame, i)


def simulate(
    obj: Object,
    exposures: Exposures,
    *,
    photons_per_pixel: float | None = None,
    seed: int = 0,
    is_test: np.ndarray | None = None,
    oversample: int | None = None,
    shutter: Shutter = Shutter(),
    light: UnevenLight = EVEN_LIGHT,
    on_progress: Advance = lambda fraction: None,
) -> Scan:
    """Simulate a scan of `obj`: wave propagation on a fine raster, pixel integration, photon noise.

    obj: any `Object`, such as a `MeshScene` or a `MeshSeries` in motion
    exposures: pose, energy, distance, blur and time of each of the N frames
    photons_per_pixel: mean counts of the Poisson noise (default: no noise)
    is_test: [N] bool, the frames to hold out (default: every fourth)
    oversample: samples along a pixel (default: as many as the fringes need, and twice as many in views of meshes with
        flat faces along the beam)
    shutter: length of the exposures, for motion blur (default: none)
    light: deviations of the light from the flat field (default: none)

    The frames [N, H, W] are relative to the flat field, and all in memory (`beamline.simulated_frames` gives them one
    by one). `on_progress(fraction)` is called after each frame. Errors: `InputError` for photons or seeds out of range,
    and for fringes that no raster of reasonable size resolves.

    Examples:

        >>> import holosplat as hs
        >>> water = hs.materials.parse_material("water").delta_beta(20.0)
        >>> views = hs.Views.evenly_spaced(8, shape=(16, 16), pixel_size=1e-6)
        >>> cells = hs.specimens.random_cells(1, box=(16e-6, 16e-6, 16e-6), seed=1)
        >>> scene = hs.MeshScene.of_one_material(cells, water)
        >>> scan = hs.simulate(scene, hs.Exposures.of(views, energy_kev=20.0, distance=0.05))
        >>> scan
        Scan(8 frames of 16 × 16 pixels, 2 of them held out)
        >>> print(f"{scan.frames.min():.2f} to {scan.frames.max():.2f} of the flat field")
        0.73 to 1.17 of the flat field
    """
    how = Simulation(photons_per_pixel, seed, oversample, shutter, light)
    frames = np.empty((len(exposures), *exposures.views.shape), dtype=np.float32)
    for i, frame in enumerate(simulated_frames(obj, exposures, how)):
        frames[i] = frame
        on_progress((i + 1) / len(exposures))
    split = interleaved_split(len(exposures)) if is_test is None else is_test
    return Scan(frames, exposures, split, how.provenance(exposures))


def polychromatic_frames(
    matter_at: Callable[[float], Object], spectrum: Spectrum, exposures: Exposures, how: Simulation
) -> Iterator[np.ndarray]:
    """Frames [H, W] float32 as `simulate.simulated_frames`, but of light with a `spectrum`.

    `matter_at(energy_kev)` is the object with its δ and β at that energy. A frame is `Σ w_e I_e`, each energy's
    intensity relative to its own flat; light and photon noise come last. All energies are sampled as the exposures'
    own is.
    """
    quiet = how.quiet(exposures)
    parts = [
        simulated_frames(matter_at(energy), replace(exposures, energy_kev=energy, reference_kev=None), quiet)
        for energy in map(float, spectrum.energies_kev)
    ]
    detect = how.detector(exposures)
    for i, of_energies in enumerate(zip(*parts)):
        yield detect(np.tensordot(spectrum.weights, np.stack(of_energies), 1), i)


def refilled(matter: MeshScene | MeshSeries, filling: Filling, energy_kev: float) -> MeshScene | MeshSeries:
    """The same bodies, filled with their materials' δ and β at `energy_kev` [keV]."""
    if isinstance(matter, MeshSeries):
        return replace(matter, snapshots=tuple(_refilled(scene, filling, energy_kev) for scene in matter.snapshots))
    return _refilled(matter, filling, energy_kev)


def _refilled(scene: MeshScene, filling: Filling, energy_kev: float) -> MeshScene:
    return replace(scene, materials=tuple(filling.of(mesh.name, energy_kev) for mesh in scene.meshes))


def read_spectrum(path: Path) -> Spectrum:
    """A spectrum from a text file of two columns, energy [keV] and weight; `#` begins a comment."""
    require_regular(path, "a text file of energies and weights (--spectrum)")
    try:
        table = np.loadtxt(path, ndmin=2)
    except (ValueError, UnicodeDecodeError):
        table = np.empty((0, 0))
    if table.shape[1] != 2 or len(table) == 0:
        raise InputError(
            f"{path} must hold two columns of numbers, energy [keV] and weight, but it does not; correct it."
        )
    return Spectrum(table[:, 0], table[:, 1])


FARTHEST = 1.0
"""Metres from the files' origin within which a field of view lies."""


@dataclass(frozen=True)
class Filling:
    """The materials of mesh files and the medium around them."""

    material: Material | Transparent | None = HAEMOGLOBIN
    """Material of meshes that no pattern of `table` matches (None: every mesh must match one)."""
    medium: Material | None = None
    """Material around the meshes; δ and β are differences to it (None: vacuum)."""
    table: dict[str, Material] = field(default_factory=dict)
    """File-name pattern → material of the meshes that it matches."""

    def of(self, name: str, energy_kev: float) -> DeltaBeta:
        """δ and β of the mesh file `name` against the medium, at `energy_kev` [keV]."""
        inside = material_of(name, self.table, self.material).delta_beta(energy_kev)
        return inside.against(self.medium.delta_beta(energy_kev)) if self.medium else inside


def read_scene(
    paths: Sequence[Path],
    filling: Filling,
    energy_kev: float,
    *,
    length_unit: str = "um",
    origin: tuple[float, float, float] | None = None,
) -> MeshScene:
    """Closed meshes from VTK files, filled, and centred on the rotation axis.

    origin: the point (x, y, z), in the files' coordinates and unit, that lies on the rotation axis at the
    centre of the field of view (default: the centre of the common bounding box).
    """
    scene = filled_scene(paths, filling, energy_kev, length_unit)
    return scene.moved(-field_centre(scene.bounds, origin, length_unit))


def filled_scene(paths: Sequence[Path], filling: Filling, energy_kev: float, length_unit: str) -> MeshScene:
    """Closed meshes from VTK files, filled, where the files have them."""
    meshes = [closed(mesh, length_unit) for mesh in read_meshes(paths, length_unit)]
    return MeshScene(tuple(meshes), tuple(filling.of(mesh.name, energy_kev) for mesh in meshes))


def field_centre(
    bounds: tuple[np.ndarray, np.ndarray], origin: tuple[float, float, float] | None, length_unit: str
) -> np.ndarray:
    """The point (x, y, z) [m] at the field's centre: `origin`, in `length_unit`, or the middle of `bounds` [m]."""
    if origin is None:
        return 0.5 * (bounds[0] + bounds[1])
    require(bool(np.all(np.isfinite(origin))), f"origin must be three finite numbers, but it is {origin}.")
    point = unit_factor("length unit", length_unit, LENGTH_UNITS) * np.array(origin)
    require(
        bool((np.abs(point) <= FARTHEST).all()),
        f"origin must lie within {FARTHEST:g} m, but it is {origin} {length_unit}.",
    )
    return point
