"""What `holosplat simulate` images: mesh files, a volume, or matter that it generates; and the source of its light."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from tyro.conf import UseAppendAction, arg

from ..checks import InputError, require
from ..ranges import Grams, Many, Metres, Positive, Seed, Signed, Small, SomeShare, checked_dataclass
from ..tables import overridden, to_table
from .options import BeamlineOptions, MaterialOptions, MeshOptions, MotionOptions

if TYPE_CHECKING:
    from ..beamline.simulate import Filling, Simulation
    from ..optics.coherence import Spectrum
    from ..scan import Exposures
    from ..specimens.drawn import Drawn, FieldKind, Truth
    from ..specimens.scene import VoxelScene

NO_SPECTRUM = (
    "a spectrum needs meshes of files, whose materials are known at every energy; leave --bandwidth and --spectrum out."
)


@checked_dataclass
class SourceOptions:
    """What the light comes from; without any of these, a plane wave of one energy."""

    source_size: Metres | None = None
    """Standard deviation of the Gaussian source [m]; it blurs by this times distance / source distance."""
    source_distance: Positive | None = None
    """Distance from source to sample [m]."""
    cone: bool = False
    """--distance and --pixel-size are the detector's own, in a cone beam from --source-distance."""
    bandwidth: SomeShare | None = None
    """Relative full width at half maximum of a Gaussian spectrum about --energy-kev."""
    energies: Many = 7
    """Energies that stand for such a spectrum; each costs a simulation."""
    spectrum: Path | None = None
    """Or: a text file of two columns, energy [keV] and weight; the scan's energy is then their mean."""

    def light(self, energy_kev: float) -> Spectrum | None:
        """The spectrum about `energy_kev` [keV]; None for one energy."""
        from ..beamline.simulate import read_spectrum
        from ..optics.coherence import Spectrum

        require(self.bandwidth is None or self.spectrum is None, "give --bandwidth or --spectrum, not both.")
        if self.spectrum is not None:
            return read_spectrum(self.spectrum)
        return None if self.bandwidth is None else Spectrum.gaussian(energy_kev, self.bandwidth, self.energies)

    def applied(self, beamline: BeamlineOptions) -> BeamlineOptions:
        """The beamline in effective terms: a parallel beam's pixel and distance, the source's blur, the mean energy."""
        from ..optics.coherence import effective_geometry, joined_blur_px, source_blur

        for name in ("source_size", "cone"):
            told = self.source_distance is not None or not getattr(self, name)
            require(told, f"--{name.replace('_', '-')} needs --source-distance.")
        used = self.source_distance is None or self.cone or self.source_size is not None
        require(used, "--source-distance needs --source-size or --cone, without which it changes nothing.")
        light = self.light(beamline.energy_kev)
        if light is not None and self.spectrum is not None:
            beamline = replace(beamline, energy_kev=light.mean_kev)
        if self.source_distance is not None and self.cone:
            found = effective_geometry(self.source_distance, beamline.distance, beamline.pixel_size)
            beamline = replace(beamline, distance=found.distance, pixel_size=found.pixel_size)
        if self.source_distance is not None and self.source_size is not None:
            blur = source_blur(self.source_size, self.source_distance, beamline.distance)
            beamline = replace(
                beamline, psf_sigma_px=float(joined_blur_px(beamline.psf_sigma_px, blur, beamline.pixel_size))
            )
        return beamline

    def frames(self, matter: Truth, filling: Filling, exposures: Exposures, how: Simulation) -> Iterator[np.ndarray]:
        """Frames [H, W] of `matter`, one after another."""
        from ..beamline.simulate import polychromatic_frames, refilled, simulated_frames
        from ..specimens.scene import MeshScene, MeshSeries

        light = self.light(exposures.one_energy("a simulation"))
        if light is None:
            return simulated_frames(matter, exposures, how)
        if not isinstance(matter, MeshScene | MeshSeries):
            raise InputError(NO_SPECTRUM)
        return polychromatic_frames(lambda energy: refilled(matter, filling, energy), light, exposures, how)

    def rays(self, exposures: Exposures) -> Exposures:
        """The exposures with the rays of a cone that is wide."""
        from ..io.raw_file import with_rays

        source = self.source_distance if self.cone else None
        return replace(exposures, views=with_rays(exposures.views, source))

    def facts(self, beamline: BeamlineOptions) -> dict[str, str]:
        """What the scan file says of the source; `beamline` as it was given."""
        said = {name: str(value) for name, value in vars(self).items() if value is not None and name != "energies"}
        said.pop("cone")
        if self.cone:
            said |= {"cone_distance": str(beamline.distance), "cone_pixel_size": str(beamline.pixel_size)}
        return said


@checked_dataclass
class VolumeOptions:
    """What the images of a TIFF stack show; files of `export --volume` say it themselves."""

    voxel_size: Small | None = None
    """Edge of the cubic voxels [m]."""
    value_delta: Signed | None = None
    """δ of a value of one (default: that of --material, so that values are its share)."""
    value_delta_beta: Signed | None = None
    """δ/β, with --value-delta (default: no absorption)."""
    stacked: Literal["y", "z"] = "y"
    """Axis along which images follow each other: y, the rotation axis, for slices across it, or z."""

    def volume(self, paths: tuple[Path, ...], filling: Filling, energy_kev: float) -> VoxelScene:
        """The scene that the volume files `paths` describe."""
        from ..io.formats import StackMeaning, read_specimen
        from ..matter import DeltaBeta
        from ..specimens.scene import VoxelScene

        known = self.value_delta is not None
        require(known or self.value_delta_beta is None, "--value-delta-beta needs --value-delta.")
        if self.voxel_size is None:
            require(not known, "--value-delta needs --voxel-size; both are of TIFF images.")
            return VoxelScene(read_specimen(paths, None))
        if self.value_delta is not None:
            ratio = self.value_delta_beta
            require(ratio != 0, "--value-delta-beta must not be 0; leave it out where nothing absorbs.")
            of = DeltaBeta(self.value_delta, self.value_delta / ratio if ratio is not None else 0.0)
        else:
            of = filling.of(paths[0].name, energy_kev)
        return VoxelScene(read_specimen(paths, StackMeaning(self.voxel_size, of, self.stacked)))


@checked_dataclass
class GeneratedOptions:
    """Matter that is generated, in place of files."""

    specimen: str | None = None
    """Kind of specimen: soft-cells, tissue, bubbles, jet, lattice … (docs/simulation.md has all)."""
    specimen_size: Small | None = None
    """Its extent [m] (default: 0.85 of the shorter side of the field of view, or as its kind has it)."""
    specimen_count: Many | None = None
    """Number of cells, droplets, bubbles, threads, fibres … (default: 9, or as its kind has it)."""
    specimen_edge: Small | None = None
    """Width of the edges of soft cells, head phantom and foam [m] (default: 3 pixels, at most 4 % of the extent)."""
    specimen_radii: tuple[Small, Small] | None = None
    """Radii of the smallest and largest bubble [m], evenly spaced between (default: 5 and 14 % of the extent)."""
    specimen_overlap: bool = False
    """Whether bubbles may overlap, as those that merge."""
    specimen_set: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="NAME=VALUE")] = ()
    """Another parameter of matter that may fill the field, as wall=0.1 of a cuvette (docs/simulation.md)."""
    specimen_seed: Seed = 0
    """Seed of the specimen."""
    specimen_motion: float | None = None
    """Motion from the first frame to the last: turn of the middle of the stirred blob [degrees] (default: 60), or lost
    share of gas of the collapsing foam (default: 0.5)."""
    core: str | None = None
    """Formula or name of what --material surrounds: in coated droplets, a cuvette, a channel, or the absorber."""
    core_density: Grams | None = None
    """Its density [g/cm³]; a named one has its own."""

    def timing(self, motion: MotionOptions) -> np.ndarray:
        """The times [T] of the frames [s], the first at 0; `InputError` where `motion` and the specimen do not fit."""
        timing = motion.timing()
        if self.specimen is None or not self._kind().changes:
            require(timing is None, "--frame-rate is of moving meshes, or of a specimen that moves; leave it out.")
            return np.zeros(1)
        if timing is None or timing.frames is None or timing.frames < 2:
            raise InputError(f"--specimen {self.specimen} moves; give --frame-rate, and --frames of two or more.")
        start = timing.start
        require(start is None, f"--specimen {self.specimen} begins to move at the first frame; leave --start.")
        return np.arange(timing.frames) / timing.frame_rate

    def in_medium(self, filling: MaterialOptions) -> MaterialOptions:
        """The materials: where they are not named, those that are usual for the specimen."""
        if self.specimen is None:
            return filling
        material, _, medium = self._kind().named
        return replace(filling, material=filling.material or material, medium=filling.medium or medium)

    def matter(self, beamline: BeamlineOptions) -> FieldKind:
        """The specimen that is named, with its parameters."""
        kind = self._kind()
        require(
            self.specimen_motion is None or hasattr(kind, "motion"),
            f"--specimen-motion is of matter that moves, not of {self.specimen}; leave it.",
        )
        of_bubbles = self.specimen_radii is not None or self.specimen_overlap
        require(
            self.specimen == "bubbles" or not of_bubbles,
            f"--specimen-radii and --specimen-overlap are of bubbles, not of {self.specimen}; leave them.",
        )
        given: dict[str, Any] = {} if self.specimen_count is None else {"count": self.specimen_count}
        require(not given or hasattr(kind, "count"), f"--specimen-count is not of the {self.specimen}; leave it.")
        size = self.specimen_size or kind.extent * min(beamline.detector) * beamline.pixel_size
        if hasattr(kind, "edge"):
            given["edge"] = self._edge(size, beamline) / size
        require(
            "edge" in given or self.specimen_edge is None, f"--specimen-edge is not of the {self.specimen}; leave it."
        )
        if self.specimen_motion is not None:
            given["motion"] = self.specimen_motion
        if self.specimen_radii is not None:
            given["radii"] = tuple(radius / size for radius in self.specimen_radii)
        if self.specimen_overlap:
            given["overlap"] = True
        return overridden(kind(size, **given), self.specimen_set)

    def facts(self, beamline: BeamlineOptions) -> dict[str, str]:
        """What the scan file says of the specimen: its kind, seed, parameters, and what is inside."""
        said = {"specimen": str(self.specimen), "specimen_seed": str(self.specimen_seed)}
        found = self.matter(beamline)
        parameters = {name: value for name, value in to_table(found).items() if name != "kind"}
        lists = {name: value if isinstance(value, list) else [value] for name, value in parameters.items()}
        shown = {
            name: " ".join(f"{one:g}" if isinstance(one, float) else str(one) for one in values)
            for name, values in lists.items()
        }
        core = {"core": str(self.core or found.named[1])} if found.has_core else {}
        return said | {f"specimen_{name}": text for name, text in shown.items()} | core

    def drawn(self, beamline: BeamlineOptions, filling: Filling) -> Drawn:
        """What `matter` gives of the named materials."""
        from ..materials import parse_material
        from ..specimens.drawn import VACUUM, Substances

        found, energy = self.matter(beamline), beamline.energy_kev
        cored = self.core if found.has_core else None
        require(cored == self.core, f"--core is not of the {self.specimen}; leave it.")
        require(found.has_core or self.core_density is None, f"--core-density is not of the {self.specimen}; leave it.")
        core = cored or found.named[1]
        inside = core is not None or not found.has_core
        require(inside, f"--specimen {self.specimen} needs --core, the material that is inside.")
        medium = VACUUM if filling.medium is None else filling.medium.delta_beta(energy)
        material = replace(filling, medium=None).of(str(self.specimen), energy)
        filled = None if core is None else parse_material(core, self.core_density).delta_beta(energy)
        return found.drawn(Substances(material, filled, medium), self.specimen_seed)

    def _kind(self) -> type[FieldKind]:
        """The kind that is named. Errors: `InputError` for a name that is none."""
        from ..specimens.drawn import KINDS

        name = str(self.specimen)
        require(name in KINDS, f"--specimen must be one of {', '.join(KINDS)}, but it is {name!r}.")
        return KINDS[name]

    def _edge(self, size: float, beamline: BeamlineOptions) -> float:
        """Width of the edges [m] of what is `size` [m] wide."""
        return min(3 * beamline.pixel_size, 0.04 * size) if self.specimen_edge is None else self.specimen_edge


@dataclass(frozen=True)
class SpecimenOptions:
    """What is imaged."""

    meshes: MeshOptions = MeshOptions()
    volume: VolumeOptions = VolumeOptions()
    generated: GeneratedOptions = GeneratedOptions()

    def continuous(
        self, paths: tuple[Path, ...], beamline: BeamlineOptions, filling: Filling, duration: float = 0.0
    ) -> VoxelScene | Drawn | None:
        """The specimen, unless `paths` are meshes; `InputError` for a mixture. duration: of its motion [s]."""
        from ..io.formats import FORMATS

        of_volume = [path for path in paths if path.suffix.lower() in FORMATS]
        if self.generated.specimen is not None:
            require(not paths, "--specimen generates what is imaged; give it or files, not both.")
            return self.generated.drawn(beamline, filling).over(duration or 1.0)
        require(len(paths) > 0, "simulate needs mesh files, a volume, or --specimen.")
        if not of_volume:
            require(self.volume == VolumeOptions(), "--voxel-size and --value-delta are of TIFF images, not of meshes.")
            return None
        require(len(of_volume) == len(paths), "simulate takes meshes or a volume, but there are both; give one kind.")
        return self.volume.volume(paths, filling, beamline.energy_kev)
