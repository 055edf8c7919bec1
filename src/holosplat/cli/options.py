"""The options of the commands, in groups that belong together. Field names are the flags, docstrings their help."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from tyro.conf import UseAppendAction, arg

from ..beamline.misalignment import Directions
from ..checks import InputError, require
from ..geometry import Views
from ..io.reading import ends_of, told_energy
from ..ranges import (
    Angle,
    Frequency,
    Grams,
    Index,
    Many,
    Metres,
    Natural,
    Photons,
    Pixels,
    Seconds,
    Seed,
    Share,
    Signed,
    Small,
    Weight,
    Within,
    checked_dataclass,
    ranged,
)
from ..scan import Exposures, interleaved_split

if TYPE_CHECKING:
    from ..beamline.series import Timing
    from ..beamline.simulate import Filling, Shutter
    from ..matter import MaterialPrior, MatterKind
    from ..methods import Method


@checked_dataclass
class MeshOptions:
    """How mesh files are read."""

    length_unit: str = "um"
    """Unit of the mesh files' coordinates."""
    origin: tuple[Signed, Signed, Signed] | None = None
    """Point on the rotation axis at the field's centre, in the files' coordinates (default: the meshes' centre)."""
    snapshot_interval: Seconds | None = None
    """Series: seconds from one snapshot to the next (default: as the files say)."""
    time_unit: str | None = None
    """Series: unit of a collection's time steps (default: s)."""
    period: tuple[Weight, Weight, Weight] | None = None
    """Series: edges x, y, z of the periodic box that bodies were folded into, in the files' coordinates; 0: none."""

    def require_static(self) -> None:
        """`InputError` if something is given that only a series has."""
        stray = [name for name in ("snapshot_interval", "time_unit", "period") if getattr(self, name) is not None]
        require(not stray, f"--{stray[0].replace('_', '-') if stray else ''} goes with --frame-rate, of a series.")


@checked_dataclass
class OneMaterial:
    """One material, and what surrounds it."""

    material: str | None = None
    """Formula, or a name (holosplat materials lists them)."""
    density: Grams | None = None
    """Its density [g/cm³]; a named one has its own."""
    medium: str | None = None
    """Formula or name of what surrounds it (default: vacuum)."""
    medium_density: Grams | None = None
    """The medium's density [g/cm³]."""


@checked_dataclass
class MaterialOptions(OneMaterial):
    """What fills the meshes."""

    index: Index | None = None
    """Or, of light: their refractive index, of matter that does not absorb, in a medium of --medium-index."""
    materials: Path | None = None
    """JSON or TOML table of materials by mesh file name, for scenes of several (default: haemoglobin in all)."""

    def filling(self, medium_index: float | None = None) -> Filling:
        """The materials that the options name, in a medium of so large a refractive index for light."""
        from ..beamline.simulate import Filling
        from ..materials import Transparent, parse_material, read_material_table

        if self.index is not None:
            named = (self.material, self.density, self.medium, self.medium_density, self.materials)
            require(
                named == (None,) * 5, "--index says what fills the meshes; leave --material, --medium and the like."
            )
            return Filling(Transparent(1 - self.index / (1.0 if medium_index is None else medium_index)))

        around = None if self.medium == "vacuum" else self.medium
        stray = around is None and self.medium_density is not None
        require(not stray, "--medium-density needs a --medium other than vacuum.")
        table = read_material_table(self.materials) if self.materials else {}
        named = self.material if self.material is not None or table else "haemoglobin"
        require(named is not None or self.density is None, "--density needs --material.")
        return Filling(
            parse_material(named, self.density) if named is not None else None,
            parse_material(around, self.medium_density) if around is not None else None,
            table,
        )


@dataclass(frozen=True, kw_only=True)
@ranged
class BeamlineOptions(Directions):
    """Beam, detector and views."""

    detector: tuple[Natural, Natural]
    """Rows and columns of the detector [pixels]."""
    energy_kev: float = 20.0
    """Photon energy [keV]."""
    wavelength: Small | None = None
    """Or: wavelength in vacuum [m], of light, or of electrons."""
    medium_index: Index | None = None
    """With it: refractive index of the medium in which light travels and matter lies (default: 1)."""
    distance: Metres = 0.1
    """Effective propagation distance [m]."""
    distances: tuple[Metres, ...] = ()
    """Or several: all views are taken at each of them [m], and frames of a pose are used together."""
    pixel_size: Small = 3.2e-6
    """Effective pixel size [m]."""
    psf_sigma_px: Pixels = 0.0
    """Standard deviation of the Gaussian point-spread function [pixels]."""
    exposures: Path | None = None
    """Or: geometry.toml of align or calibrate, with the views, and the distances, energies and pixels that it says."""
    test_every: int = 4
    """One view in so many is held out of the fit (0: none)."""

    def told(self) -> BeamlineOptions:
        """The same with one photon energy and what --exposures says; `InputError` for options that say it twice."""
        once = not self.distances or (self.distance == BeamlineOptions.distance and self.exposures is None)
        require(once, "--distances says how far the detector is; leave --distance, or --exposures.")
        told = None if self.energy_kev == BeamlineOptions.energy_kev else self.energy_kev
        energy = told_energy(told, self.wavelength, self.medium_index)
        own = self if energy is None else replace(self, energy_kev=float(energy))
        if self.exposures is None:
            return own
        from ..io.beams import read_beams

        said = read_beams(self.exposures).scalars()
        for name in said:
            twice = getattr(own, name) != getattr(BeamlineOptions, name)
            require(not twice, f"--exposures {self.exposures} says it already; leave --{name.replace('_', '-')}.")
        return replace(own, **said)

    def planned(self) -> Exposures:
        """How each frame is taken."""
        if self.exposures is not None:
            from ..io.beams import read_beams

            others = (getattr(self, one.name) != one.default for one in fields(Directions))
            require(not any(others), "--exposures says where views are; leave the other options of views.")
            beams = read_beams(self.exposures)
            rotations = np.array([each.matrix() for each in beams.view])
            views = Views.from_rotations(rotations, self.detector, self.pixel_size)
            return beams.on(Exposures.of(views, self.energy_kev, self.distance, self.psf_sigma_px))
        views = self.on(self.detector, self.pixel_size)
        one = Exposures.of(views, self.energy_kev, self.distance, self.psf_sigma_px)
        if not self.distances:
            return one
        several = one[list(range(len(one))) * len(self.distances)]
        return replace(several, distance=[z for z in self.distances for _ in range(len(one))])  # type: ignore[arg-type]

    def split(self, count: int) -> np.ndarray:
        """[count] bool: the frames that are held out; of several distances, all frames of a pose, or none."""
        if self.distances:
            poses = replace(self, distances=()).split(count // len(self.distances))
            return poses[[n % len(poses) for n in range(count)]]

        every = self.test_every
        require(every == 0 or every > 1, f"--test-every must be 0 (hold out none) or at least 2, but it is {every}.")
        return interleaved_split(count, self.test_every)


@checked_dataclass
class NoiseOptions:
    """Photon noise."""

    photons_per_pixel: Photons | None = None
    """Mean photons a pixel for Poisson noise (default: no noise)."""
    seed: Seed = 0
    """Seed of the noise."""


@checked_dataclass
class MotionOptions:
    """Moving meshes: a time-resolved scan, all views of a time taken at the same instant."""

    frame_rate: Frequency | None = None
    """Times a second [Hz]; the meshes are then snapshots of a motion, and between them move straight."""
    frames: Annotated[int, Within(1, 10**6)] | None = None
    """Number of times (default: as many as the snapshots cover)."""
    start: Seconds | None = None
    """Time of the first frames after the first snapshot [s] (default: as early as can be)."""
    exposure: Seconds = 0.0
    """Motion blur: how long a frame gathers light, about its time [s]."""
    pulses: Many = 1
    """Motion blur: flashes in that, evenly spaced, whose intensities are averaged."""
    hold_out: Literal["views", "times"] = "views"
    """What --test-every counts: views, the same ones at every time, or times, with all their views."""

    def shutter(self) -> Shutter:
        """The motion blur."""
        from ..beamline.simulate import Shutter

        return Shutter(self.exposure, self.pulses)

    def timing(self) -> Timing | None:
        """When frames are taken; None for meshes that do not move."""
        from ..beamline.series import Timing

        if self.frame_rate is not None:
            return Timing(self.frame_rate, self.frames, self.start, self.shutter())
        for name, default in vars(MotionOptions()).items():
            require(getattr(self, name) == default, f"--{name.replace('_', '-')} needs --frame-rate, of moving meshes.")
        return None


@checked_dataclass
class MisalignmentOptions:
    """Errors of each view that the scan file does not know of; --true-exposures keeps them."""

    misalign_shift: Pixels = 0.0
    """Standard deviation of the detector's shift along rows and columns [pixels]."""
    misalign_rotation: Angle = 0.0
    """Standard deviation of small turns about x, y and z [degrees]."""
    misalign_distance: Share = 0.0
    """Standard deviation of the distance, as a share of it."""
    misalign_magnification: Share = 0.0
    """Standard deviation of the magnification, as a share of it."""
    misalign_seed: Seed = 0
    """Seed of these errors."""


@checked_dataclass
class MethodOptions:
    """How the reconstruction proceeds."""

    method: str | None = None
    """Name of the method: auto (what you get without), gaussians, surfaces, volume (continuous matter),
    voxels, neural-field, holographic-tv, tikhonov-tv and other pairs of phase retrieval and tomography; pinn
    (all times of a scan at once, bound by equations of flow)."""
    matter: Literal["auto", "levels", "continuous"] = "auto"
    """Whether matter has levels of density with sharp edges, or is continuous; auto: the frames decide."""
    preset: str | None = None
    """Named options of Gaussians: default, fast, random, thesis."""
    config: Path | None = None
    """Or: a JSON or TOML file of options, whole or partial, such as the config.json of another run."""
    changes: Annotated[UseAppendAction[tuple[str, ...]], arg(name="set", metavar="PATH=VALUE")] = ()
    """Change one option, such as fit.schedule.steps=500 or fit.steps=500; may be given again and again."""
    start: Literal["phase", "learned", "random"] | None = None
    """Start of Gaussians: phase retrieval with tomography; a trained network, where that explains the frames clearly
    better; or random, with the settings of that preset (default: as the options say, phase)."""
    backend: Literal["auto", "cpu", "cuda", "reference"] | None = None
    """What computes the fit (default: as the options say, auto); `holosplat backends` lists what there is."""

    def kind_of_matter(self) -> MatterKind | None:
        """The kind of matter, if it is told."""
        return None if self.matter == "auto" else self.matter

    def chosen(self) -> Method:
        """The method that the options name; `InputError` if its backend cannot be used here."""
        from ..backends import resolve
        from ..methods import Auto, Gaussians, Surfaces
        from ..methods.presets import chosen_method, preset
        from ..tables import overridden

        given = [f"--{name}" for name in ("method", "preset", "config") if getattr(self, name) is not None]
        require(len(given) < 2, f"give one of --method, --preset and --config, but there are {' and '.join(given)}.")
        method = chosen_method(self.method, self.preset, self.config, self.changes)
        if self.start is not None:
            require(
                isinstance(method, Auto | Gaussians | Surfaces),
                f"--start says what Gaussians begin with (--method auto, gaussians or surfaces), but the method is "
                f"{method.kind}; leave --start.",
            )
            if self.start == "random" and self.preset is None and self.config is None:
                settings: Method = preset("random")  # others move it too little
                if isinstance(method, Auto | Surfaces):
                    settings = replace(method, gaussians=settings)
                method = overridden(settings, self.changes)
            else:
                where = "start" if isinstance(method, Gaussians) else "gaussians.start"
                method = overridden(method, (*self.changes, f"{where}={self.start}"))
        if self.backend:
            method = method.on_backend(self.backend)
        resolve(self.backend or "auto")  # before the start, which takes its time
        return method


@checked_dataclass
class PriorOptions:
    """What is known of the matter; without any of these, one material or two are found, with their δ and β."""

    material: UseAppendAction[tuple[str, ...]] = ()
    """Formula or name of the material, if known (then δ and β are); again for each further one."""
    density: UseAppendAction[tuple[Grams, ...]] = ()
    """Density of each formula [g/cm³], in their order."""
    medium: str | None = None
    """Formula or name of what surrounds them (default: vacuum)."""
    medium_density: Grams | None = None
    """The medium's density [g/cm³]."""
    delta_beta: Signed | str | None = None
    """Or: only the ratio δ/β of the one material is known, or a range LOW:HIGH of it (for `reconstruct`)."""
    contrast: Literal["auto", "above", "below", "both"] = "auto"
    """Side of the medium's δ on which matter lies; both: continuous matter such as a shock; auto: by material or
    frames."""

    def ranges(self) -> dict[str, tuple[float, float]]:
        """What is said as a range, by name."""
        return {"delta_beta": ends_of("delta_beta", self.delta_beta)} if isinstance(self.delta_beta, str) else {}

    def without_ranges(self) -> PriorOptions:
        """The same, with nothing where a range is said."""
        require(not self.material or self.delta_beta is None, "give --material or --delta-beta, not both.")
        return replace(self, delta_beta=None) if self.ranges() else self

    def prior(self, energy_kev: float, wall: str | None = None) -> MaterialPrior:
        """The prior at `energy_kev` [keV] in a `wall`; `InputError` for a range of δ/β, and a medium that is not the
        filling."""
        from ..materials import require_in_wall
        from ..matter import MaterialPrior

        require(not self.material or self.delta_beta is None, "give --material or --delta-beta, not both.")
        if not self.material:
            belongs = ("density", "medium", "medium_density")
            stray = [f"--{name.replace('_', '-')}" for name in belongs if getattr(self, name) not in (None, ())]
            beside = " rather than --delta-beta" if self.delta_beta is not None else ""
            require(not stray, f"{', '.join(stray)} can only go with --material{beside}; add it, or leave them.")
            if isinstance(self.delta_beta, str):
                said = f"it is {self.delta_beta!r}; a range is for reconstruct alone."
                raise InputError(f"--delta-beta must be one number here, but {said}")
            free = MaterialPrior.unknown() if self.delta_beta is None else MaterialPrior.of_ratio(self.delta_beta)
            return self._sided(free)
        around = (self.medium, self.medium_density)
        told = [MaterialOptions(*each, *around).filling() for each in self._with_densities()]
        if wall is not None:
            require_in_wall(wall, told[0].medium)
        medium = self.medium if told[0].medium else None
        return self._sided(MaterialPrior.known(*(each.of("", energy_kev) for each in told), medium=medium or ""))

    def _sided(self, prior: MaterialPrior) -> MaterialPrior:
        """The prior with what `contrast` says."""
        if self.contrast == "auto":
            return prior
        if self.contrast == "both":
            return prior.on_both_sides()
        sign = 1 if self.contrast == "above" else -1
        require(
            not prior.materials or (prior.sign == sign and not prior.two_sided),
            f"--contrast must be on the side of --material, but it is {self.contrast}, and a material's δ lies on "
            "the other side of its medium's; leave --contrast.",
        )
        return prior.signed(sign)

    def _with_densities(self) -> list[tuple[str, float | None]]:
        """Each material with the density that is given for it."""
        from ..materials import is_named

        count = len(self.density)
        if count == len(self.material):
            return list(zip(self.material, self.density))
        formulas = [name for name in self.material if not is_named(name)]
        require(
            count in (0, len(formulas)),
            f"--density must be given once for each material, or once for each formula ({len(formulas)}), but it is "
            f"given {count} times; leave those of materials with a name.",
        )
        densities = iter(self.density)
        return [(name, None if is_named(name) else next(densities, None)) for name in self.material]
