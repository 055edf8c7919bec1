"""Files of frames of all kinds (projections, flats, darks) that are open for reading, and the loaders of formats."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np

from ..checks import UnsaidError, in_range, note, require
from ..divided_light import DividedLight
from ..geometry import Views, rotation_y
from ..preprocess.pixels import mean_frame
from ..scan import DISTANCE_RANGE_M, PIXEL_RANGE_M, Exposures, Scan, checked_distance
from ..units import BEAM_RANGE_KEV
from .stacks import ImageStack

PROJECTION, FLAT, DARK, INVALID = range(4)

TAKES = ("energy_kev", "distance", "pixel_size", "source_distance", "angles_deg", "flats", "darks")
"""What may be said beside a file, and then goes before what the file says."""
FARTHEST_M = 1e4
PARALLEL = 1.001
"""A smaller magnification is that of a parallel beam."""
WIDEST = 0.02
"""Tangent of half the angle of a cone of rays, at most, that is taken for parallel at the object."""
RAW_TAKES = (*TAKES, "leave_out")
"""The same for files whose flats and darks are read frame by frame."""
NOTHING: Mapping[str, Any] = {}
RANGES = {
    "energy_kev": (BEAM_RANGE_KEV, "keV"),
    "distance": (DISTANCE_RANGE_M, "metres"),
    "pixel_size": (PIXEL_RANGE_M, "metres"),
}


STAND_INS = {"energy_kev": 20.0, "distance": 0.1, "pixel_size": 1e-6}
NAMES = {"energy_kev": "photon energy", "distance": "propagation distance", "pixel_size": "pixel size"}


class Stack(Protocol):
    """Frames [n, H, W] of numbers, read by number and rows: a dataset of HDF5, an array, pages of TIFF files."""

    @property
    def shape(self) -> tuple[int, ...]:
        """(n, H, W)."""
        ...

    def __getitem__(self, index: Any, /) -> Any: ...


@dataclass(frozen=True)
class ScanFile:
    """A file that is open: how its n projections were taken, and its N frames of all kinds, read one by one.

    path, label: the file, and what messages call its frames.
    stacks: the frames, one stack behind the other.
    kinds: [N], PROJECTION, FLAT, DARK or INVALID; where they stand in the file, `kinds_label` says.
    exposures, is_test: of the projections.
    flips: whether the file's frames are upside down, and whether they are mirrored left to right.
    marked: [H, W], not 0 for pixels that the file marks as defective, as stored; None if it marks none.
    texts: the provenance.
    has_given_fields: whether flats and darks that are said beside it are among its frames already.
    divided: what is not known of light that its projections were divided by, if it says so.
    are_counts: whether frames of whole numbers are those of a camera (`rows`).
    """

    path: Path
    label: str
    stacks: tuple[Stack, ...]
    kinds: np.ndarray
    exposures: Exposures
    is_test: np.ndarray
    flips: tuple[bool, bool] = (False, False)
    marked: np.ndarray | None = None
    texts: Mapping[str, str] = field(default_factory=dict)
    kinds_label: str = "the file"
    has_given_fields: bool = False
    divided: DividedLight | None = None
    are_counts: bool = True

    @classmethod
    def of(
        cls,
        path: Path,
        parts: Sequence[tuple[int, Stack | None]],
        given: Mapping[str, Any],
        found: Mapping[str, Any],
        label: str = "",
        kinds_label: str = "",
    ) -> ScanFile:
        """That of `parts`, stacks of one kind each (`together`), whose exposures are `given`, or else `found` in it
        (`exposures_of`); nothing is held out. label, kinds_label: its path where they are left out."""
        stacks, kinds = together(str(path), parts)
        projections, shape = kinds == PROJECTION, stacks[0].shape
        exposures = exposures_of(str(path), given, found, (shape[1], shape[2]), projections)
        held_out = np.zeros(len(exposures), dtype=bool)
        return cls(path, label or str(path), stacks, kinds, exposures, held_out, kinds_label=kinds_label or str(path))

    def numbers(self, kind: int) -> np.ndarray:
        """Which of the N frames are of `kind`."""
        return np.flatnonzero(self.kinds == kind)

    def name(self, number: int) -> str:
        """What messages call frame `number`: that, and the name of its file where each frame has one."""
        begin = 0
        for stack in self.stacks:
            if isinstance(stack, ImageStack) and begin <= number < begin + stack.shape[0]:
                return f"frame {number} ({stack.name(number - begin)})"
            begin += stack.shape[0]
        return f"frame {number}"

    def frame(self, number: int) -> np.ndarray:
        """Frame `number` [H, W] as float64, turned upright."""
        return self.rows(number, slice(0, self.exposures.views.shape[0]))

    def rows(self, number: int, rows: slice) -> np.ndarray:
        """The rows `rows` (from start to stop) of frame `number`, float64, turned upright; the greatest whole number of
        a camera, which stands for more light than it counts, or marks a gap, is NaN."""
        upside_down, mirrored = self.flips
        height = self.exposures.views.shape[0]
        stored = slice(height - rows.stop, height - rows.start) if upside_down else rows
        for stack in self.stacks:
            if number < stack.shape[0]:
                values = np.asarray(stack[int(number), stored])
                found = values.astype(np.float64)
                if self.are_counts and values.dtype.kind in "iu":
                    found[values == np.iinfo(values.dtype).max] = np.nan
                return found[:: -1 if upside_down else 1, :: -1 if mirrored else 1]
            number -= stack.shape[0]
        raise IndexError(number)

    def mean(self, kind: int) -> np.ndarray:
        """The mean [H, W] of the frames of `kind`; zeros where there are none."""
        return mean_frame((self.frame(n) for n in self.numbers(kind)), self.exposures.views.shape)

    def mask(self) -> np.ndarray:
        """[H, W] bool: the pixels that the file marks as defective, turned upright."""
        if self.marked is None:
            return np.zeros(self.exposures.views.shape, dtype=bool)
        return (self.marked != 0)[:: -1 if self.flips[0] else 1, :: -1 if self.flips[1] else 1]

    def provenance(self) -> dict[str, str]:
        """The provenance of the scan."""
        return dict(self.texts)


Opens = Callable[[Path, Mapping[str, Any]], AbstractContextManager[ScanFile]]
"""Opens a file, with values that are said beside it (`TAKES`)."""


# --- what files of other programs leave out -------------------------------------------------------------------


def said(given: Mapping[str, Any], name: str) -> float | None:
    """The value `name` (energy_kev, distance, pixel_size) that is said beside a file; None if there is none."""
    if given.get(name) is None:
        return None
    if name == "distance":
        return checked_distance(given[name], "--distance")
    bounds, unit = RANGES[name]
    return in_range(f"--{name.replace('_', '-')}", given[name], *bounds, unit=unit)


def stand_in(*names: str) -> dict[str, float]:
    """Values for `names` (of `STAND_INS`) with which a file that does not say them can be looked at."""
    return {name: STAND_INS[name] for name in names}


def magnified(
    label: str, source: float, distance: float | np.ndarray, pixel: float, shape: Sequence[int]
) -> float | np.ndarray:
    """Magnification (R + z) / R of a source R before the sample, of detectors z behind it; 1 for a parallel beam.

    label: what messages call the source; source, distance: R and z [m]; pixel: of the detector [m]; shape: of frames.
    Distance and pixel over it are those of the parallel beam of the same waves (`optics.coherence`); for rays see
    `with_rays`. Errors: `InputError` for a distance that cannot be.
    """
    before = in_range(label, source, 1e-6, FARTHEST_M, unit="metres")
    found = 1 + np.asarray(distance, dtype=np.float64) / before
    if found.max() < PARALLEL:
        return 1.0
    half = 0.5 * max(shape)
    tangent = half * pixel / (before * float(found.min()))
    if tangent > WIDEST:
        rays = f"rays are those of a cone, tangent of half its angle {tangent:.2g}"
    else:
        rays = (
            "rays are taken for parallel: at the frames' edge, the front and the back of an object as deep as they are "
            f"wide lie {2 * tangent * half:.2g} pixels apart"
        )
    note(
        f"{label}: the source is {before:.4g} m before the sample; pixels and distance at the detector are divided by "
        f"the magnification of {float(found.max()):.4g}; {rays}"
    )
    return found if found.ndim else float(found)


def with_rays(views: Views, source: float | None) -> Views:
    """The views with the rays of a point source [m] before the sample, if these are a wide cone (`WIDEST`); None: far
    away."""
    if source is None or 0.5 * float(views.fields.max()) <= WIDEST * source:
        return views
    return replace(views, sources=np.full(len(views), source))


def require_said(label: str, missing: Sequence[str]) -> None:
    """`UnsaidError` that names the options for what neither a file nor the command says, all of it at once."""
    if missing:
        options = [f"--{name.replace('_', '-')}" for name in missing]
        what, how = (_listed(words) for words in ([NAMES[name] for name in missing], options))
        said = f"{label} does not say the {what}; say {'it' if len(missing) == 1 else 'them'} by {how}."
        raise UnsaidError(said, stand_in(*missing))


def _listed(words: Sequence[str]) -> str:
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"


def angles_of_projections(angles_deg: np.ndarray, projections: np.ndarray) -> np.ndarray:
    """The angles [n] of the frames `projections` [N] bool, of angles that count all frames or the projections only."""
    total, count = len(projections), int(projections.sum())
    both = f"{count} frames" if count == total else f"{count} projections, or of all {total} frames"
    require(
        len(angles_deg) in (count, total),
        f"there must be one angle for each of the {both}, but there are {len(angles_deg)}; correct --angles.",
    )
    return angles_deg[projections] if len(angles_deg) == total else angles_deg


def exposures_of(
    label: str, given: Mapping[str, Any], found: Mapping[str, Any], shape: tuple[int, int], projections: np.ndarray
) -> Exposures:
    """Exposures of the frames `projections` [N] bool of (H, W) pixels: what is `given`, or else `found` in the file.

    Both by name: energy_kev [keV], distance [m], pixel_size [m], angles_deg. One projection needs no angle. Where the
    distance of the source is given, `source_distance` [m], all are the detector's own; where it is found, those that
    are found (`magnified`).
    """
    told = {name: said({name: found.get(name) if given.get(name) is None else given[name]}, name) for name in RANGES}
    values = {name: value for name, value in told.items() if value is not None}
    require_said(label, [name for name in RANGES if name not in values])
    told_source = given.get("source_distance")
    if (source := found.get("source_distance") if told_source is None else told_source) is not None:
        own = {name for name in ("distance", "pixel_size") if told_source is not None or given.get(name) is None}
        behind, pixel = ((values if name in own else found).get(name, 0.0) for name in ("distance", "pixel_size"))
        where = f"{label}: the source" if told_source is None else "--source-distance"
        larger = magnified(where, source, behind, pixel, shape)
        values |= {name: values[name] / float(larger) for name in own}
    angles = given["angles_deg"] if given.get("angles_deg") is not None else found.get("angles_deg")
    if angles is None and int(projections.sum()) == 1:
        angles = np.zeros(1)
    if angles is None:
        raise UnsaidError(
            f"{label} does not say the frames' angles; name a text file of them by --angles FILE.",
            {"angles_deg": np.zeros(int(projections.sum()))},
        )
    count, angles = int(projections.sum()), np.asarray(angles, dtype=np.float64).reshape(-1)
    frames = "frames" if len(projections) == count else "projections (flats and darks have none)"
    require(
        len(angles) == count,
        f"there must be one angle for each of the {count} {frames}, but there are {len(angles)}; correct --angles.",
    )
    turned = rotation_y(angles)
    views = with_rays(Views.from_rotations(turned, shape, values["pixel_size"]), source)
    return Exposures.of(views, values["energy_kev"], values["distance"])


def together(label: str, parts: Sequence[tuple[int, Stack | None]]) -> tuple[tuple[Stack, ...], np.ndarray]:
    """Stacks of one kind each, and the kinds [N] of all frames; `InputError` for stacks that are not [n, H, W]
    alike."""
    stacks: list[Stack] = []
    kinds: list[int] = []
    for kind, stack in parts:
        if stack is None:
            continue
        require(
            len(stack.shape) == 3 and 0 not in stack.shape,
            f"{label}: frames must have the shape [N, H, W], but {('projections', 'flats', 'darks')[kind]} have "
            f"{tuple(stack.shape)}.",
        )
        same = not stacks or tuple(stack.shape[1:]) == tuple(stacks[0].shape[1:])
        require(
            same,
            f"{label}: flats and darks must have the frames' {tuple(stacks[0].shape[1:]) if stacks else ()} pixels, "
            f"but some have {tuple(stack.shape[1:])}.",
        )
        stacks.append(stack)
        kinds += [kind] * stack.shape[0]
    return tuple(stacks), np.array(kinds)


@dataclass(frozen=True)
class Loader:
    """One format of scans, recognised by the content of a path.

    name: of the format, for messages.
    mark: description of a path of that format ("a folder with scan.json").
    recognises: whether a path is one, by its content.
    read: the scan at such a path, with the values that it lacks.
    takes: names of these values (energy_kev [keV], distance [m], pixel_size [m], angles_deg [N], flats and darks,
        paths of images; files, the names of images in a folder; entry, of an HDF5 file; black, white).
    opens: opens such a file frame by frame, raw ones with their flats and darks; None where frames are corrected.
    is_general: whether it takes what none of the others recognises.
    remark: a sentence for whoever converts such a scan; empty: none.
    """

    name: str
    mark: str
    recognises: Callable[[Path], bool]
    read: Callable[[Path, Mapping[str, Any]], Scan]
    takes: tuple[str, ...] = ()
    opens: Opens | None = None
    is_general: bool = False
    remark: Callable[[Path, Scan], str] = lambda path, scan: ""


Retrieved = Callable[[], tuple[np.ndarray, float]]
"""Retrieves the thickness [N, H, W] [m] of the material that is told in the frames of a scan, and its δ."""


class Writer(NamedTuple):
    """A format that scans are written in. write: a scan to a path, by options, and with what is retrieved of a
    material (None: none is told); a warning, or an empty text; takes: names of the options, and `material`."""

    write: Callable[[Path, Scan, Mapping[str, Any], Retrieved | None], str]
    takes: tuple[str, ...] = ()


def folder_with(*names: str) -> Callable[[Path], bool]:
    """Whether a path is a folder that holds all the files `names`."""
    return lambda path: path.is_dir() and all((path / name).is_file() for name in names)
