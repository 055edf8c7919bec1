"""How a scan is read: what is said beside its files, and which part of it is taken."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from ..checks import InputError, require
from ..ranges import Frequency, Index, Natural, Positive, Signed, Small, checked_dataclass
from ..tables import LARGEST, from_table, number_in, shown, to_table
from ..units import photon_energy
from .angles import read_angles, tell_angles, tell_views

if TYPE_CHECKING:
    from ..scan import Scan
    from .beams import Beams

Sense = Literal["clockwise", "anticlockwise"]

WIDTHS = ("bandwidth", "source_size", "psf_sigma_px")
"""Fields of `Told` that say how wide something is, of which a range means that it may be nothing, too."""
OWN_WAY = (
    *("wavelength", "medium_index", "angles", "axis_column", "sense", "tube", "wall", "exposures", "allow_external"),
    *WIDTHS,
)
"""Fields of `Told` that no loader takes by their own name."""


@checked_dataclass
class Told:
    """What is said of a scan beside its files; it goes before what they say themselves."""

    energy_kev: float | str | None = None
    """Photon energy [keV], or a range LOW:HIGH for `reconstruct` (default: as the files say)."""
    wavelength: Small | None = None
    """Or: wavelength in vacuum [m], of light, or of electrons (default: as the files say)."""
    medium_index: Index | None = None
    """With it: refractive index of the medium in which light travels and matter lies (default: 1)."""
    distance: float | str | None = None
    """Effective propagation distance [m], or a range LOW:HIGH for `reconstruct` (default: as the files say)."""
    pixel_size: Small | None = None
    """Effective pixel size [m] (default: as the files say)."""
    source_distance: Positive | None = None
    """Distance from a point source to the sample [m]; distance and pixel are then those of the detector itself."""
    bandwidth: float | str | None = None
    """Relative full width at half maximum ΔE/E of the spectrum, or a range LOW:HIGH (default: the files', or 0)."""
    source_size: float | str | None = None
    """Standard deviation of the source [m], which adds to the blur, or such a range; with --source-distance."""
    psf_sigma_px: float | str | None = None
    """Standard deviation of the detector's blur [pixels], or such a range (default: as the files say, or 0)."""
    angles: Path | None = None
    """Text file of the frames' angles [degrees]: one a line, or a named column (default: as the files say)."""
    exposures: Path | None = None
    """geometry.toml of align or calibrate, which overrides the files: a view for each frame, or for each frame of every
    time (default: as the files say)."""
    flats: Path | None = None
    """Images without the object: TIFF, PNG, HDF5, .npy or .npz, or a folder of images (default: the files' own)."""
    darks: Path | None = None
    """Images without light, likewise."""
    leave_out: str | None = None
    """Frames to leave out, counted from 0 in the files, as --views; those of --flats and --darks follow (default: odd
    flats and darks)."""
    files: str | None = None
    """Of a folder of images: the names of the projections, such as 'raw_*.tif' (default: all but flat* and dark*)."""
    entry: str | None = None
    """HDF5: the group to read, where a file holds several scans."""
    allow_external: bool = False
    """HDF5: follow links to other files and virtual datasets, as some beamlines write them; only of files you trust."""
    sources: str | None = None
    """European XFEL: the cameras that are the views, names or parts of them with commas between (default: HPVX2)."""
    trains: str | None = None
    """European XFEL: trains to take, counted from 0, as --views (default: all)."""
    pulses: str | None = None
    """European XFEL: pulses of a train to take, counted from 0, as --views (default: all)."""
    frame_rate: Frequency | None = None
    """European XFEL: frames a second that the camera takes within a train [Hz]."""
    axis_column: Signed | None = None
    """Column of the rotation axis in the files' frames, the first being 0 (default: the files', or the middle)."""
    sense: Sense = "clockwise"
    """How the object turns as the angle grows, seen from above (row 0 at the top, the beam going away)."""
    tube: str | None = None
    """Tube about the axis to divide out, INNER:OUTER:ATTENUATION: diameters [m] and µ [1/m], as in 4e-3:4.5e-3:200."""
    wall: str | None = None
    """Container, modelled with the matter: tube:INNER:OUTER:MATERIAL:FILLING (diameters [m]), cuvette: (WIDTHxDEPTH
    each), or slab:INNER:MATERIAL:FILLING beyond the field; for instance tube:4e-5:5e-5:glass:water."""
    black: Signed | None = None
    """Grey images, nerf-synthetic: intensity of black pixels, relative to the flat field (default: 0)."""
    white: Signed | None = None
    """Grey images, nerf-synthetic: intensity of white pixels, relative to the flat field (default: 1)."""

    def energy(self) -> float | str | None:
        """The photon energy [keV], or its range, also by the wavelength; `InputError` for both, and beyond X-rays."""
        if isinstance(self.energy_kev, float | int):
            from ..scan import ENERGY_RANGE_KEV  # needs geometry, which reading an option does not

            low, high = ENERGY_RANGE_KEV
            require(
                low <= self.energy_kev <= high,
                f"--energy-kev must lie between {low:g} and {high:g} keV, but it is {self.energy_kev:g}; check its "
                "unit, or say light and electrons by --wavelength.",
            )
        return told_energy(self.energy_kev, self.wavelength, self.medium_index)

    def ranges(self) -> dict[str, tuple[float, float]]:
        """What is said as a range LOW:HIGH, by name."""
        said = {name: getattr(self, name) for name in ("energy_kev", "distance", *WIDTHS)}
        return {name: ends_of(name, value) for name, value in said.items() if isinstance(value, str)}

    def uncertain(self) -> dict[str, tuple[float, float]]:
        """The same as a reconstruction has it: of a source it is the angle that its size subtends [rad]."""
        found = self.ranges()
        if "source_size" in found:
            low, high = found.pop("source_size")
            found["source_angle"] = low / self._from_source(), high / self._from_source()
        return found

    def at_middle(self) -> Told:
        """The same with the geometric mean of each range, and without the widths, which may be none."""
        middle = {name: math.sqrt(low * high) for name, (low, high) in self.ranges().items()}
        return replace(self, **{name: None if name in WIDTHS else value for name, value in middle.items()})

    def found(self, constants: Mapping[str, float]) -> Told:
        """The same with what a reconstruction found for the ranges; a source's size is among its constants alone."""
        return replace(self, **{name: constants.get(name) for name in self.ranges()})

    def _from_source(self) -> float:
        if self.source_distance is None:
            raise InputError("--source-size needs --source-distance, for it blurs by their ratio; give both.")
        return self.source_distance

    def given(self, takes: Sequence[str] = ()) -> dict[str, Any]:
        """The values for a loader that `takes` such, by name, with `angles_deg` [N]; `InputError` for ranges."""
        for name in self.ranges():
            option, text = f"--{name.replace('_', '-')}", getattr(self, name)
            raise InputError(f"{option} must be one number here, but it is {text!r}; a range is for reconstruct alone.")
        said = {name: value for name, value in vars(self).items() if value is not None and name not in OWN_WAY}
        if (energy := self.energy()) is not None:
            said["energy_kev"] = energy
        beams = self._beams()
        said |= {name: value for name, value in (beams.scalars() if beams else {}).items() if name in takes}
        if self.angles is None:
            return said
        angles = read_angles(self.angles)
        tell_angles(angles, str(self.angles))
        return {**said, "angles_deg": angles}

    def vouch(self, path: Path) -> None:
        """From now on the scan at `path`, its flats and darks may bring values of other files, if that is said."""
        if not self.allow_external:
            return
        from .hdf5_guard import allow_external  # needs h5py, which reading an option does not

        for one in (path, self.flats, self.darks):
            if one is not None:
                allow_external(one)

    def placed(self, scan: Scan) -> Scan:
        """The scan in the exposures of --exposures, or with the axis and the sense of rotation that are said."""
        if (beams := self._beams()) is not None:
            return self._of_light(beams.applied(scan))
        views = scan.views
        if self.axis_column is not None:
            views = views.about_column(self.axis_column)
        views = views if self.sense == "clockwise" else views.turned_back()
        return self._of_light(scan if views is scan.views else scan.with_views(views))

    def _of_light(self, scan: Scan) -> Scan:
        """The scan with the widths of spectrum, source and detector that are said as numbers."""
        said = {name: value for name in WIDTHS if isinstance(value := getattr(self, name), float | int)}
        if not said:
            return scan
        from ..optics.coherence import joined_blur_px, source_blur

        size = said.pop("source_size", None)
        exposures = replace(scan.exposures, **said)
        if size is not None:
            blur = source_blur(size, self._from_source(), exposures.distance)
            sigma = joined_blur_px(exposures.psf_sigma_px, blur, exposures.views.pixel_sizes)
            exposures = replace(exposures, psf_sigma_px=sigma)
        return scan.taken(exposures)

    def _beams(self) -> Beams | None:
        """What --exposures names. Errors: `InputError` for options that say the same."""
        if self.exposures is None:
            return None
        from .beams import read_beams  # needs torch, which reading an option does not

        beams, usual = read_beams(self.exposures), Told()
        twice = ["axis_column", "sense", *beams.scalars()]
        for name in (name for name in twice if getattr(self, name) != getattr(usual, name)):
            raise InputError(f"--exposures {self.exposures} says it already; leave --{name.replace('_', '-')}.")
        return beams


@checked_dataclass
class Part:
    """Which part of a scan is taken."""

    time_frame: int | Literal["all", "still", "each"] | None = None
    """Of a time-resolved scan: the time to take, counted from 0 (still, each, all: older names of --motion)."""
    time_frames: str | None = None
    """Times to take of a time-resolved scan, counted from 0, as --views, such as 0:24; --time-frame counts these."""
    views: str | None = None
    """Frames to take, counted from 0: numbers and ranges start:stop:step, as in 0:91:8 or 3,5,20:30."""
    test_views: str | None = None
    """Frames to hold out of the fit, in the same form; the others are then for training (default: as the files say)."""
    crop: str | None = None
    """Rows and columns to keep, such as 0:40,10:150, in pixels of the files' frames; : keeps all."""
    bin: Natural = 1
    """Average pixels this many by this many, after cropping."""

    def of(self, scan: Scan) -> Scan:
        """This part of `scan`; frames keep their order, pixels their place in space.

        Errors: `InputError` for frames, rows, columns or times that the scan does not have.
        """
        if self.time_frames is not None:
            kept = scan.instants[marked("--time-frames", self.time_frames, len(scan.instants))]
            scan = scan[np.flatnonzero(np.isin(scan.exposures.time, kept))]
        scan = at_time(scan, self.time_frame)
        taken = np.ones(len(scan), dtype=bool) if self.views is None else marked("--views", self.views, len(scan))
        if self.test_views is not None:
            held_out = marked("--test-views", self.test_views, len(scan))
            scan, taken = scan.with_split(held_out), taken | held_out
        scan = scan if taken.all() else scan[np.flatnonzero(taken)]
        if self.crop is not None:
            scan = scan.cropped(*_corner(self.crop, scan.views.shape))
        return scan.binned(self.bin)


@dataclass(frozen=True)
class Reading:
    """How a scan is read."""

    told: Told = field(default_factory=Told)
    part: Part = field(default_factory=Part)

    def applied(self, scan: Scan, joined: bool = True) -> Scan:
        """A scan that a loader has read, with its axis and sense of rotation, and cut to the part that is taken.

        joined: whether opposite frames of a half acquisition become wider ones (`stitched`), and those of a helix
            taller ones (`heightened`).
        """
        scan = self.told.placed(scan)
        if joined:
            from .larger_frames import heightened, stitched  # SciPy, without which help is printed

            scan = heightened(stitched(scan))
        tell_views(scan)
        if self.told.tube is not None:
            from .larger_frames import Tube

            scan = Tube.parsed(self.told.tube).taken_out_of(scan)
        if (said := self.told.wall) is not None:
            from ..materials import wall_of  # xraydb, without which help is printed

            wall = wall_of(said, scan.exposures.reference_energy)
            scan = scan.taken(replace(scan.exposures, wall=wall), {"wall": said})
        return self.part.of(scan)

    def as_table(self) -> dict[str, Any]:
        """What differs from the default, by field, ready for JSON; paths are absolute. `time_frame` is not there."""
        said = _said(self.told) | _said(replace(self.part, time_frame=None))
        return {name: to_table(value.resolve() if isinstance(value, Path) else value) for name, value in said.items()}

    @classmethod
    def from_table(cls, table: dict[str, Any], where: str = "") -> Reading:
        """The reading of `as_table`. Errors: `InputError` for entries that are unknown or of another type."""
        parts = {field.name for field in fields(Part)}
        told = {name: value for name, value in table.items() if name not in parts}
        part = {name: value for name, value in table.items() if name in parts}
        return cls(from_table(Told, told, where), from_table(Part, part, where))

    def over(self, other: Reading) -> Reading:
        """`other` with all that differs from the default here."""
        return Reading(replace(other.told, **_said(self.told)), replace(other.part, **_said(self.part)))


def told_energy(energy: float | str | None, wavelength: float | None, index: float | None) -> float | str | None:
    """The photon energy [keV] by energy or wavelength and index; `InputError` for both, and for an index alone."""
    if wavelength is None:
        require(index is None, "--medium-index needs --wavelength, which is shorter in the medium; give both.")
        return energy
    require(energy is None, "--energy-kev and --wavelength say the same; give one of them.")
    return photon_energy(wavelength, 1.0 if index is None else index)


def ends_of(name: str, text: str) -> tuple[float, float]:
    """The range that the `text` LOW:HIGH of the option `name` says. Errors: `InputError` for anything else."""
    words = text.split(":")
    low, high = (number_in(word) for word in words) if len(words) == 2 else (math.nan, math.nan)
    require(
        0 < low * high < math.inf and abs(low) < abs(high),
        f"--{name.replace('_', '-')} must be a number, or a range LOW:HIGH of numbers above 0, the smaller one first, "
        f"but it is {text!r}; correct it.",
    )
    return low, high


def _said(kind: Told | Part) -> dict[str, Any]:
    """The fields that differ from the default."""
    return {name: value for name, value in vars(kind).items() if value != getattr(type(kind)(), name)}


def at_time(scan: Scan, time_frame: int | str | None) -> Scan:
    """The frames of the instant `time_frame`, of "all" or "still" as if nothing moved, or (None) the scan as it is."""
    if time_frame is None:
        return scan
    require(time_frame != "each", "--time-frame each is of reconstruct (--motion each); give the number of a time.")
    return scan.at_instant(time_frame) if isinstance(time_frame, int) else scan.as_static()


def _corner(text: str, shape: tuple[int, int]) -> tuple[slice, slice]:
    """The rows and columns of `--crop`, with `shape` (H, W) filled in where a bound is left out."""
    parts = text.split(",")
    require(len(parts) == 2, f"--crop must be ROWS,COLUMNS, as in 0:40,10:150, but it is {text!r}.")
    found = []
    for name, part, count in zip(("rows", "columns"), parts, shape):
        start, stop, step = _bounds("--crop", part, "rows and columns are written start:stop, as in 0:40,10:150")
        require(step is None, f"--crop takes {name} one by one, but it says {part!r}; use --bin for larger pixels.")
        low, high, _ = slice(start, stop).indices(count)
        inside = low < high and all(bound is None or -count <= bound <= count for bound in (start, stop))
        require(inside, f"--crop must keep some of the {count} {name}, but it says {part!r}.")
        found.append(slice(low, high))
    return found[0], found[1]


def marked(option: str, text: str, count: int) -> np.ndarray:
    """[count] bool: the numbers and ranges, with commas, in the `text` of an option; `InputError` for others."""
    found = np.zeros(count, dtype=bool)
    for part in text.split(","):
        if ":" in part:
            start, stop, step = _bounds(option, part, "ranges are written start:stop:step, as in 0:91:8")
            require(step is None or step > 0, f"{option} must go forwards, but it says {part!r}.")
            found[start:stop:step] = True
            continue
        number = _whole(option, part)
        require(
            -count <= number < count,
            f"{option} counts what there is from 0 to {count - 1}, but it says {number}.",
        )
        found[number] = True
    require(bool(found.any()), f"{option} must name some, but {text!r} names none of the {count}.")
    return found


def _bounds(option: str, text: str, advice: str) -> tuple[int | None, int | None, int | None]:
    words = text.split(":")
    require(2 <= len(words) <= 3, f"{option} cannot be {text!r}: {advice}.")
    start, stop, step = (_whole(option, word) if word.strip() else None for word in [*words, ""][:3])
    require(step != 0, f"{option} cannot go in steps of 0.")
    return start, stop, step


def _whole(option: str, word: str) -> int:
    try:
        found = int(word)
    except ValueError:
        found = None
    if found is None or abs(found) > LARGEST:
        raise InputError(f"{option} must be made of whole numbers, as in 0:91:8 or 3,5, but it says {shown(word)}.")
    return found
