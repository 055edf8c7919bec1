"""Files of frames of all kinds (projections, flats, darks) that are open for reading, whatever their format."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

import h5py
import numpy as np

from ..checks import InputError, finite, in_range, require
from ..divided_light import DividedLight
from ..frames import Frames
from ..geometry import Views, rotation_y
from ..preprocess.flat_field import mean_frame, relative_intensity, unlit
from ..scan import DISTANCE_RANGE_M, ENERGY_RANGE_KEV, PIXEL_RANGE_M, Exposures, Scan, checked_distance
from .hdf5 import open_hdf5
from .stacks import stack_of

PROJECTION, FLAT, DARK, INVALID = range(4)

TAKES = ("energy_kev", "distance", "pixel_size", "angles_deg", "flats", "darks")
"""What may be said beside a file, and then goes before what the file says."""
NOTHING: Mapping[str, Any] = {}
RANGES = {
    "energy_kev": (ENERGY_RANGE_KEV, "keV"),
    "distance": (DISTANCE_RANGE_M, "metres"),
    "pixel_size": (PIXEL_RANGE_M, "metres"),
}


NAMES = {"energy_kev": "photon energy", "distance": "propagation distance", "pixel_size": "pixel size"}


class Stack(Protocol):
    """Frames [n, H, W] of numbers, read by number and rows: a dataset of HDF5, an array, pages of TIFF files."""

    @property
    def shape(self) -> tuple[int, ...]:
        """(n, H, W)."""
        ...

    def __getitem__(self, index: Any, /) -> Any: ...


def rows_of(stacks: Sequence[Stack], number: int, rows: slice, flips: tuple[bool, bool] = (False, False)) -> np.ndarray:
    """The rows `rows` (from start to stop) of frame `number` of stacks that follow each other, float64, turned upright.

    flips: whether the stored frames are upside down, and mirrored left to right.
    """
    for stack in stacks:
        if number < stack.shape[0]:
            upside_down, mirrored = flips
            height = stack.shape[1]
            stored = slice(height - rows.stop, height - rows.start) if upside_down else rows
            found = np.asarray(stack[number, stored]).astype(np.float64)
            return found[:: -1 if upside_down else 1, :: -1 if mirrored else 1]
        number -= stack.shape[0]
    raise IndexError(number)


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

    def numbers(self, kind: int) -> np.ndarray:
        """Which of the N frames are of `kind`."""
        return np.flatnonzero(self.kinds == kind)

    def frame(self, number: int) -> np.ndarray:
        """Frame `number` [H, W] as float64, turned upright."""
        return self.rows(number, slice(0, self.exposures.views.shape[0]))

    def rows(self, number: int, rows: slice) -> np.ndarray:
        """The rows `rows` (from start to stop) of frame `number`, float64, turned upright."""
        return rows_of(self.stacks, int(number), rows, self.flips)

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


@dataclass(frozen=True)
class _Place:
    """Where a dataset is: in the file that was opened, or in one to which it links, where that is allowed."""

    file: Path
    name: str

    @classmethod
    def of(cls, dataset: h5py.Dataset) -> _Place:
        path = Path(dataset.file.filename).resolve()
        return cls(path, str(dataset.name))


@dataclass(frozen=True)
class StoredFrames(Frames):
    """The projections of a file, flat-field corrected when they are read.

    stacks: of the file; a dataset of HDF5 by its place.
    numbers: [N] of the projections among the file's frames.
    dark, light: [H, W] mean dark field and mean flat field less that, light None where the file is corrected already.
    stamp: of the file when it was opened.

    The file is opened anew for each reading. Errors: `InputError` for a file that is gone or changed, or values not
    finite.
    """

    path: Path
    label: str
    stacks: tuple[Stack | _Place, ...]
    flips: tuple[bool, bool]
    numbers: np.ndarray
    dark: np.ndarray
    light: np.ndarray | None
    shape: tuple[int, int, int]
    stamp: tuple[int, ...]

    @classmethod
    def of(cls, file: ScanFile) -> StoredFrames:
        """Those of an open file, whose dark and flat frames are read for their means."""
        numbers, path = file.numbers(PROJECTION), file.path.resolve()
        dark, light = _fields_of_light(file)
        stacks = tuple(_Place.of(stack) if isinstance(stack, h5py.Dataset) else stack for stack in file.stacks)
        whole = (len(numbers), *file.exposures.views.shape)
        return cls(path, file.label, stacks, file.flips, numbers, dark, light, whole, _stamp(path))

    def read(self, numbers: np.ndarray) -> np.ndarray:
        """See `Frames.read`."""
        gone = f"{self.path} must be the file that was opened, but it is gone; put it back, or open another."
        require(self.path.exists(), gone)
        changed = f"{self.path} must be the file that was opened, but it has changed since; open it again."
        require(_stamp(self.path) == self.stamp, changed)
        frames = np.empty((len(numbers), *self.shape[1:]), dtype=np.float32)
        files = {stack.file for stack in self.stacks if isinstance(stack, _Place)}
        with ExitStack() as opened:
            file = {path: opened.enter_context(open_hdf5(path)) for path in files}
            stacks: list[Any] = [
                file[stack.file][stack.name] if isinstance(stack, _Place) else stack for stack in self.stacks
            ]
            for i, n in enumerate(self.numbers[numbers]):  # one by one: raw frames are wider, and there may be many
                raw = rows_of(stacks, int(n), slice(0, self.shape[1]), self.flips)
                frames[i] = raw if self.light is None else relative_intensity(raw, self.dark, self.light)
        return finite(self.label, frames)


def reader(opens: Opens) -> Callable[[Path, Mapping[str, Any]], Scan]:
    """What reads the projections of a file that `opens` opens, flat-field corrected, and how they were taken.

    Frames marked flat and dark correct the others: (frame - mean dark) / (mean flat - mean dark); frames marked
    invalid are dropped. The projections are read when they are asked for (`StoredFrames`).
    """

    def read(path: Path, given: Mapping[str, Any]) -> Scan:
        with opens(path, given) as opened:
            file = with_fields(opened, given)
            return Scan.of(StoredFrames.of(file), file.exposures, file.is_test, file.provenance(), file.divided)

    return read


def with_fields(file: ScanFile, given: Mapping[str, Any]) -> ScanFile:
    """The file with the flats and darks that are `given` beside it (paths of images or arrays), after its own."""
    extra = [(kind, given.get(name)) for kind, name in ((FLAT, "flats"), (DARK, "darks"))]
    if file.has_given_fields or all(path is None for _, path in extra):
        return file
    parts = [(kind, stack_of(path)) for kind, path in extra if path is not None]
    stacks, kinds = together(str(file.path), [(PROJECTION, file.stacks[0]), *parts])
    more = kinds[file.stacks[0].shape[0] :]
    return replace(file, stacks=(*file.stacks, *stacks[1:]), kinds=np.concatenate([file.kinds, more]))


def _stamp(path: Path) -> tuple[int, ...]:
    """What changes when a file is written anew."""
    found = path.stat()
    return found.st_mtime_ns, found.st_size, found.st_ino


def _fields_of_light(file: ScanFile) -> tuple[np.ndarray, np.ndarray | None]:
    """The mean dark field [H, W], and the mean flat field less that, None where the file has no flats."""
    flats, darks = file.numbers(FLAT), file.numbers(DARK)
    if len(darks) and not len(flats):
        raise InputError(f"{file.kinds_label} must mark flats (1) beside the dark ones (2), but it marks none.")
    dark = file.mean(DARK)
    if not len(flats):
        return dark, None
    light = file.mean(FLAT) - dark
    bad = int(unlit(light).sum())
    require(
        bad == 0,
        f"{file.label} must have flat frames brighter than dark ones everywhere, but in {bad} of {light.size} pixels "
        "they are not; `holosplat correct` repairs such pixels.",
    )
    return dark, light


# --- what files of other programs leave out -------------------------------------------------------------------


def said(given: Mapping[str, Any], name: str) -> float | None:
    """The value `name` (energy_kev, distance, pixel_size) that is said beside a file; None if there is none."""
    if given.get(name) is None:
        return None
    if name == "distance":
        return checked_distance(given[name], "--distance")
    bounds, unit = RANGES[name]
    return in_range(f"--{name.replace('_', '-')}", given[name], *bounds, unit=unit)


def require_said(label: str, missing: Sequence[str]) -> None:
    """`InputError` that names the options for what neither a file nor the command says, all of it at once."""
    if missing:
        options = [f"--{name.replace('_', '-')}" for name in missing]
        what, how = (_listed(words) for words in ([NAMES[name] for name in missing], options))
        raise InputError(f"{label} does not say the {what}; say {'it' if len(missing) == 1 else 'them'} by {how}.")


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

    Both by name: energy_kev [keV], distance [m], pixel_size [m], angles_deg. One projection needs no angle.
    """
    told = {name: said({name: found.get(name) if given.get(name) is None else given[name]}, name) for name in RANGES}
    values = {name: value for name, value in told.items() if value is not None}
    require_said(label, [name for name in RANGES if name not in values])
    angles = given["angles_deg"] if given.get("angles_deg") is not None else found.get("angles_deg")
    if angles is None and int(projections.sum()) == 1:
        angles = np.zeros(1)
    if angles is None:
        raise InputError(f"{label} does not say the frames' angles; name a text file of them by --angles FILE.")
    turned = rotation_y(angles_of_projections(np.asarray(angles, dtype=np.float64).reshape(-1), projections))
    views = Views.from_rotations(turned, shape, values["pixel_size"])
    return Exposures.of(views, values["energy_kev"], values["distance"])


def together(label: str, parts: Sequence[tuple[int, Stack | None]]) -> tuple[tuple[Stack, ...], np.ndarray]:
    """Stacks of one kind each as the frames of one file: the stacks, and the kinds [N] of all frames.

    Errors: `InputError` for stacks that are not [n, H, W], or of another size than the first.
    """
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
