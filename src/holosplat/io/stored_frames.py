"""Projections of raw files, flat-field corrected and mended when they are read; which frames of a file count."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from ..checks import InputError, note, require
from ..frames import Derived, Frames, Taken
from ..preprocess.pixels import FILLED, MOST_DEFECTS, filled, lit, relative_intensity
from ..scan import Scan
from .hdf5 import open_hdf5
from .light_frames import light_frames, require_filled
from .odd_light import Beside, without_odd
from .raw_file import DARK, FLAT, INVALID, PROJECTION, Opens, ScanFile, Stack, rows_of, together
from .reading import marked
from .stacks import ImageStack


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
class StoredFrames(Derived):
    """The projections of a file, flat-field corrected when they are read.

    stacks: of the file; a dataset of HDF5 by its place.
    numbers: [N] of the projections among the file's frames.
    dark, light: [H, W] mean dark field and mean flat field less that, light None where the file is corrected already.
    mask: [H, W] bool of the pixels that are marked as defective. These, and values that are not finite, are missing:
    they are filled from their neighbours, and their number is said.
    held: the file that holds each projection, and its stamp when it was opened; are_counts: as of `rows_of`;
    is_still: whether they are of one time, so that all show the same matter.

    The file is opened anew for each reading. Errors: `InputError` for a file that is gone or changed, or of which more
    than a part `MOST_DEFECTS` of a frame is to be filled.
    """

    path: Path
    label: str
    stacks: tuple[Stack | _Place, ...]
    flips: tuple[bool, bool]
    numbers: np.ndarray
    dark: np.ndarray
    light: np.ndarray | None
    mask: np.ndarray
    shape: tuple[int, int, int]
    held: tuple[tuple[Path, tuple[int, ...]], ...]
    are_counts: bool = True
    is_still: bool = True

    @classmethod
    def of(cls, file: ScanFile) -> StoredFrames:
        """Those of an open file, whose dark and flat frames are read for their means."""
        numbers, path = file.numbers(PROJECTION), file.path.resolve()
        mask = file.mask()
        require(
            mask.mean() <= MOST_DEFECTS,
            f"{file.label}: its pixel_mask marks {mask.mean():.0%} of the pixels as defective; 0 must stand for good "
            "ones.",
        )
        dark, light = _fields_of_light(file)
        if mask.any():
            note(f"{file.label}: the {int(mask.sum())} pixels that the file marks as defective {FILLED}")
        if light is not None:
            light, mask = lit(file.label, light, mask)
        stacks = tuple(_Place.of(stack) if isinstance(stack, h5py.Dataset) else stack for stack in file.stacks)
        whole = (len(numbers), *file.exposures.views.shape)
        places = [place for stack in file.stacks for place in _places_of(stack, path)]
        held = tuple((places[n], _stamp(places[n])) for n in numbers)
        told = (file.are_counts, len(np.unique(file.exposures.time)) == 1)
        return cls(path, file.label, stacks, file.flips, numbers, dark, light, mask, whole, held, *told)

    def with_missing(self, numbers: np.ndarray) -> Taken:
        """See `Frames.with_missing`."""
        for place, stamp in {self.held[n] for n in numbers}:
            gone = f"{place} must be the file that was opened, but it is gone; put it back, or open another."
            require(place.exists(), gone)
            changed = f"{place} must be the file that was opened, but it has changed since; open it again."
            require(_stamp(place) == stamp, changed)
        frames = np.empty((len(numbers), *self.shape[1:]), dtype=np.float32)
        files = {stack.file for stack in self.stacks if isinstance(stack, _Place)}
        with ExitStack() as opened:
            file = {path: opened.enter_context(open_hdf5(path)) for path in files}
            stacks: list[Any] = [
                file[stack.file][stack.name] if isinstance(stack, _Place) else stack for stack in self.stacks
            ]
            for i, n in enumerate(self.numbers[numbers]):  # one by one: raw frames are wider, and there may be many
                raw = rows_of(stacks, int(n), slice(0, self.shape[1]), self.flips, self.are_counts)
                frames[i] = raw if self.light is None else relative_intensity(raw, self.dark, self.light)
        found = filled(self.label, frames, ~np.isfinite(frames) & ~self.mask, self.mask, self.numbers[numbers])
        if 0 in numbers:  # once, where all pass by in turn
            beside = Beside(self.label, self.is_still, self.light)
            for number, frame in zip(self.numbers[numbers], frames):
                beside.add(int(number), frame)
            beside.tell()
        return found


def _places_of(stack: Stack, path: Path) -> list[Path]:
    """The file that holds each frame of a stack of the file or folder `path`."""
    if isinstance(stack, ImageStack):
        return [place for place, _ in stack.pages]
    return [path] * stack.shape[0]


class Mended(Derived):
    """Frames whose pixels that are not above 0, which no light can be, are missing, too."""

    def __init__(self, frames: np.ndarray | Frames, missing: np.ndarray | None = None) -> None:
        self._frames, self._missing = frames, missing
        self.shape = (frames.shape[0], frames.shape[1], frames.shape[2])

    def with_missing(self, numbers: np.ndarray) -> Taken:
        """See `Frames.with_missing`."""
        if isinstance(self._frames, Frames):
            frames, before = self._frames.with_missing(numbers)
        else:
            frames, before = np.array(self._frames[numbers]), None if self._missing is None else self._missing[numbers]
        before = np.zeros(frames.shape, dtype=bool) if before is None else before
        return filled("the scan", frames, (frames <= 0) & ~before, before, np.arange(self.shape[0])[numbers])


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
    return dark, file.mean(FLAT) - dark if len(flats) else None


def with_fields(file: ScanFile, given: Mapping[str, Any]) -> ScanFile:
    """The file with the flats and darks that are `given` beside it (paths), after its own, and without frames to leave
    out: those that are `given` by number, or flats and darks that are unlike the others of their kind.

    Errors: `InputError` for frames without data.
    """
    file = _without(_with_given(file, given), given.get("leave_out"))
    begin = 0
    for stack in file.stacks:
        if isinstance(stack, h5py.Dataset):
            gaps = require_filled(stack, file.label, file.kinds[begin : begin + len(stack)] != INVALID)
            if gaps is not None:
                file = replace(file, marked=gaps if file.marked is None else gaps | (file.marked != 0))
        begin += stack.shape[0]
    return without_odd(file, is_told=given.get("leave_out") is not None)


def _with_given(file: ScanFile, given: Mapping[str, Any]) -> ScanFile:
    extra = [(kind, given.get(name)) for kind, name in ((FLAT, "flats"), (DARK, "darks"))]
    if file.has_given_fields or all(path is None for _, path in extra):
        return file
    names = {FLAT: "flat|white", DARK: "dark"}
    parts = [(kind, light_frames(path, names[kind], kind)) for kind, path in extra if path is not None]
    stacks, kinds = together(str(file.path), [(PROJECTION, file.stacks[0]), *parts])
    more = kinds[file.stacks[0].shape[0] :]
    return replace(file, stacks=(*file.stacks, *stacks[1:]), kinds=np.concatenate([file.kinds, more]))


def _without(file: ScanFile, numbers: str | None) -> ScanFile:
    """The file without the frames that --leave-out names."""
    if numbers is None:
        return file
    left = marked("--leave-out", numbers, len(file.kinds))
    kept = ~left[file.numbers(PROJECTION)]
    require(bool(kept.any()), "--leave-out must leave some projections, but it names them all.")
    divided = None if file.divided is None else file.divided[np.flatnonzero(kept)]
    kinds, exposures = np.where(left, INVALID, file.kinds), file.exposures[np.flatnonzero(kept)]
    return replace(file, kinds=kinds, exposures=exposures, is_test=file.is_test[kept], divided=divided)
