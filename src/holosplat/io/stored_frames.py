"""Projections of raw files, corrected and mended when they are read; flats and darks beside; frames without data."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import h5py
import numpy as np
from h5py import h5p, h5s  # pyright: ignore[reportAttributeAccessIssue]  # compiled, without stubs

from ..checks import InputError, note, require
from ..frames import Derived, Taken
from ..preprocess.pixels import FILLED, MOST_DEFECTS, filled, lit, relative_intensity
from ..scan import Scan
from .guard import read_archive
from .hdf5 import open_hdf5
from .hdf5_guard import chunks_of, opened_for_reading, virtual_places
from .larger_frames import Rearranged
from .odd_light import Beside, without_odd
from .raw_file import DARK, FLAT, INVALID, PROJECTION, RAW_TAKES, Loader, Opens, ScanFile, together
from .reading import marked
from .stacks import ImageStack, stack_of

KEYS = ("image_key_control", "image_key")
FRAMES = re.compile("data|counts|frames|image", re.IGNORECASE)
NAMED = {FLAT: "flat|white", DARK: "dark"}
"""Names of the datasets of flats and of darks."""


@dataclass(frozen=True)
class DatasetStack:
    """Frames [n, H, W] of a dataset in an HDF5 file, those of `numbers`; the file is opened anew for each."""

    path: Path
    dataset: str
    numbers: tuple[int, ...]
    shape: tuple[int, int, int]

    def __getitem__(self, index: tuple[int, slice]) -> np.ndarray:
        number, rows = index
        with open_hdf5(self.path) as file:
            dataset = cast(h5py.Dataset, file[self.dataset])
            return dataset[rows] if dataset.ndim == 2 else dataset[self.numbers[number], rows]


def light_frames(path: Path, names: str, key: int) -> ImageStack | DatasetStack | np.ndarray:
    """The frames of a file or a folder of images, of an archive, or of an HDF5 file of any layout.

    names: an expression that datasets of these frames match; key: their image key. Of an HDF5 file they are those of
    the dataset that is named so, is named as frames are, or is the only one: the frames with that key or, where none
    has it, projections, or all. Errors: `InputError` for a file without frames, or with several that may be meant.
    """
    if path.is_file() and h5py.is_hdf5(path):
        with open_hdf5(path) as file:
            found: dict[str, h5py.Dataset] = {}

            def take(name: str, item: Any) -> None:
                is_array = isinstance(item, h5py.Dataset) and item.ndim in (2, 3) and item.dtype.kind in "iuf"
                if is_array and min(item.shape) > 0:
                    found[name] = item

            file.visititems(take)  # each dataset once, whatever links lead to it
            dataset = found[name := _chosen(path, found, names)]
            count = len(dataset) if dataset.ndim == 3 else 1
            numbers, beside = np.arange(count), cast(h5py.Group, dataset.parent)
            keys = next((beside[k] for k in KEYS if k in beside), None)
            if isinstance(keys, h5py.Dataset) and keys.shape == (count,):
                marks = np.asarray(keys)
                numbers = next((n for mark in (key, 0) if len(n := np.flatnonzero(marks == mark))), numbers)
            require_filled(dataset, f"{path}: /{name}", np.isin(np.arange(count), numbers))
            return DatasetStack(path, name, tuple(numbers.tolist()), (len(numbers), *dataset.shape[-2:]))
    if path.suffix.lower() == ".npz" and path.is_file():
        arrays = read_archive(path).items()
        frames = {name: array for name, array in arrays if array.ndim in (2, 3) and array.dtype.kind in "iuf"}
        array = frames[_chosen(path, frames, names)]
        return array.reshape(-1, *array.shape[-2:])
    return stack_of(path)


def _chosen(path: Path, found: Mapping[str, Any], names: str) -> str:
    """The name of the frames that are meant."""
    require(len(found) > 0, f"{path} must hold frames [N, H, W] of numbers, but it holds none; name another file.")
    for like in (re.compile(names, re.IGNORECASE), FRAMES, re.compile("")):
        chosen = [name for name in found if like.search(name.rsplit("/", 1)[-1])]
        if len(chosen) == 1:
            return chosen[0]
        if chosen:
            break
    raise InputError(f"{path} must hold frames of one kind, but it holds {', '.join(chosen)}; write one to a file.")


Seen = frozenset[tuple[str, str]]
"""Datasets, by file and name, of which one is put together."""


def require_filled(dataset: h5py.Dataset, label: str, wanted: np.ndarray) -> np.ndarray | None:
    """The pixels [H, W] bool for which no frame of `dataset` [N, H, W] has data, as between the modules of a detector;
    None where there are none. Errors: `InputError` if some of the frames `wanted` [N] bool lack more than these."""
    filled, gaps = _filled(dataset)
    empty = np.flatnonzero(~filled & wanted)
    shown = ", ".join(map(str, empty[:8])) + (" …" if len(empty) > 8 else "")
    require(
        len(empty) == 0,
        f"{label} must have data for each frame, but for {len(empty)} of {len(dataset)} it has none ({shown}, counted "
        "from 0): they were never written, or its sources lack them. Bring the whole files, or leave these frames out "
        "by --leave-out.",
    )
    if not gaps.any():
        return None
    note(f"{label}: pixels that no source fills ({int(gaps.sum())}) count as defective")
    return gaps


def _filled(dataset: h5py.Dataset, seen: Seen = frozenset()) -> tuple[np.ndarray, np.ndarray]:
    """[N] bool: whether there is data for all values of a frame that any source reaches; the others, [H, W] bool."""
    place = (dataset.file.filename, str(dataset.name))
    if not dataset.is_virtual or place in seen:  # HDF5 itself refuses one that is made of itself
        return _written(dataset), np.zeros(dataset.shape[1:], dtype=bool)
    plan, total = dataset.id.get_create_plist(), len(dataset)
    held, reached = np.zeros(total, dtype=np.int64), np.zeros(dataset.shape[1:], dtype=bool)
    for number in range(plan.get_virtual_count()):
        space = plan.get_virtual_vspace(number)
        numbers = _indices(space, 0, total)
        if numbers is None:  # it grows with its sources
            return np.ones(total, dtype=bool), np.zeros(dataset.shape[1:], dtype=bool)
        rest = [_indices(space, axis, size) for axis, size in enumerate(dataset.shape[1:], 1)]
        reached[np.ix_(*(np.arange(size) if found is None else found for found, size in zip(rest, reached.shape)))] = (
            True
        )
        there = _there(plan, number, len(numbers), Path(dataset.file.filename), seen | {place})
        held[numbers[there]] += space.get_select_npoints() // len(numbers)
    return held >= int(reached.sum()), ~reached


def _written(dataset: h5py.Dataset) -> np.ndarray:
    """[N] bool: whether the values of a frame were ever written, as far as the file tells."""
    if dataset.chunks is None:
        return np.full(len(dataset), dataset.external is not None or dataset.id.get_storage_size() > 0)
    grid = [-(-size // length) for size, length in zip(dataset.shape, dataset.chunks)]
    rows = np.zeros(grid[0], dtype=np.int64)
    if dataset.id.get_num_chunks() == math.prod(grid):
        return np.ones(len(dataset), dtype=bool)
    for offset, _, _ in chunks_of(dataset.id):
        rows[offset[0] // dataset.chunks[0]] += 1
    return np.repeat(rows == math.prod(grid[1:]), dataset.chunks[0])[: len(dataset)]


def _indices(space: h5s.SpaceID, axis: int, total: int) -> np.ndarray | None:
    """The indices along `axis` that a selection reaches; None where it has no end."""
    if space.get_select_type() == h5s.SEL_ALL:
        return np.arange(total)
    if space.is_regular_hyperslab():
        start, stride, count, block = (each[axis] for each in space.get_regular_hyperslab())
        if min(count, block) < 0 or max(count, block) >= h5s.UNLIMITED % 2**64:
            return None
        return (start + stride * np.arange(count)[:, None] + np.arange(block)).ravel()
    first, last = space.get_select_bounds()
    return np.arange(first[axis], last[axis] + 1)


def _there(plan: h5p.PropDCID, number: int, count: int, path: Path, seen: Seen) -> np.ndarray:
    """[count] bool: for which of its frames a mapping finds data in its source."""
    name, dataset = plan.get_virtual_filename(number), plan.get_virtual_dsetname(number)
    wanted = plan.get_virtual_srcspace(number)
    for place in [path] if name == "." else virtual_places(path, name):
        with opened_for_reading(place) as file:
            found = file.get(dataset)
            if not isinstance(found, h5py.Dataset) or not found.shape:
                break
            if wanted.get_select_type() != h5s.SEL_ALL and len(wanted.get_simple_extent_dims()) != found.ndim:
                break
            numbers, *rest = (_indices(wanted, axis, size) for axis, size in enumerate(found.shape))
            if numbers is None:
                break
            if any(each is not None and each.max() >= size for each, size in zip(rest, found.shape[1:])):
                break
            there = numbers < len(found)
            there[there] &= _filled(found, seen)[0][numbers[there]]
            if found.ndim < 3:  # an image, whose rows are no frames
                return np.full(count, there.all())
            return np.pad(there, (0, max(0, count - len(there))))[:count]
    return np.zeros(count, dtype=bool)


@dataclass(frozen=True)
class _Place:
    """Where a dataset is: in the file that was opened, or in one to which it links, where that is allowed."""

    file: Path
    name: str


@dataclass(frozen=True)
class StoredFrames(Derived):
    """The projections of a file, flat-field corrected when they are read.

    file: closed, with datasets of HDF5 by their places; numbers: [N] of the projections among its frames.
    dark, light: [H, W] mean dark field and mean flat field less that, light None where the file is corrected already.
    mask: [H, W] bool of the pixels that are marked as defective. These, and values that are not finite, are missing:
    they are filled from their neighbours, and their number is said.
    held: the file that holds each projection, and its stamp when it was opened.

    The file is opened anew for each reading. Errors: `InputError` for a file that is gone or changed, or of which more
    than a part `MOST_DEFECTS` of a frame is to be filled.
    """

    file: ScanFile
    numbers: np.ndarray
    dark: np.ndarray
    light: np.ndarray | None
    mask: np.ndarray
    shape: tuple[int, int, int]
    held: tuple[tuple[Path, tuple[int, ...]], ...]

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
        has_flats = len(file.numbers(FLAT)) > 0
        require(
            has_flats or len(file.numbers(DARK)) == 0,
            f"{file.kinds_label} must mark flats (1) beside the dark ones (2), but it marks none.",
        )
        dark, light = file.mean(DARK), None
        if mask.any():
            note(f"{file.label}: pixels that the file marks as defective ({int(mask.sum())}) {FILLED}")
        if has_flats:
            light, mask = lit(file.label, file.mean(FLAT) - dark, mask)
        stacks, places = list[Any](), list[Path]()
        for stack in file.stacks:
            if isinstance(stack, h5py.Dataset):
                stacks.append(_Place(Path(stack.file.filename).resolve(), str(stack.name)))
            else:
                stacks.append(stack)
            places += [place for place, _ in stack.pages] if isinstance(stack, ImageStack) else [path] * stack.shape[0]
        held = tuple((places[n], _stamp(places[n])) for n in numbers)
        closed = replace(file, stacks=tuple(stacks), texts={}, divided=None)
        return cls(closed, numbers, dark, light, mask, (len(numbers), *file.exposures.views.shape), held)

    def with_missing(self, numbers: np.ndarray) -> Taken:
        """See `Frames.with_missing`."""
        for place, stamp in {self.held[n] for n in numbers}:
            gone = f"{place} must be the file that was opened, but it is gone; put it back, or open another."
            require(place.exists(), gone)
            changed = f"{place} must be the file that was opened, but it has changed since; open it again."
            require(_stamp(place) == stamp, changed)
        frames = np.empty((len(numbers), *self.shape[1:]), dtype=np.float32)
        stacks: list[Any] = list(self.file.stacks)
        with ExitStack() as opened:
            files = {stack.file for stack in stacks if isinstance(stack, _Place)}
            file = {path: opened.enter_context(open_hdf5(path)) for path in files}
            stacks = [file[stack.file][stack.name] if isinstance(stack, _Place) else stack for stack in stacks]
            again = replace(self.file, stacks=tuple(stacks))
            for i, n in enumerate(self.numbers[numbers]):  # one by one: raw frames are wider, and there may be many
                raw = again.frame(n)
                frames[i] = raw if self.light is None else relative_intensity(raw, self.dark, self.light)
        label = self.file.label
        found = filled(label, frames, ~np.isfinite(frames) & ~self.mask, self.mask, self.numbers[numbers])
        if 0 in numbers:  # once, where all pass by in turn
            is_still = len(np.unique(self.file.exposures.time)) == 1  # so that all show the same matter
            beside = Beside(label, is_still, self.light)
            for number, frame in zip(self.numbers[numbers], frames):
                beside.add(int(number), frame)
            beside.tell()
        return found


class Mended(Rearranged):
    """The frames of a scan whose pixels that are not above 0, which no light can be, are missing, too."""

    def with_missing(self, numbers: np.ndarray) -> Taken:
        """See `Frames.with_missing`."""
        frames, before = self.taken(numbers)
        before = np.zeros(frames.shape, dtype=bool) if before is None else before
        return filled("the scan", frames, (frames <= 0) & ~before, before, np.arange(self.shape[0])[numbers])


def raw_loader(
    name: str,
    mark: str,
    recognises: Callable[[Path], bool],
    opens: Opens,
    takes: tuple[str, ...] = RAW_TAKES,
    *,
    is_general: bool = False,
) -> Loader:
    """The loader of a format that `opens` opens, which reads the projections, (frame - mean dark) / (mean flat - mean
    dark), when they are asked for (`StoredFrames`); frames marked invalid are dropped."""

    def read(path: Path, given: Mapping[str, Any]) -> Scan:
        with opens(path, given) as opened:
            file = with_fields(opened, given)
            return Scan.of(StoredFrames.of(file), file.exposures, file.is_test, file.provenance(), file.divided)

    return Loader(name, mark, recognises, read, takes, opens, is_general)


def _stamp(path: Path) -> tuple[int, ...]:
    """What changes when a file is written anew."""
    found = path.stat()
    return found.st_mtime_ns, found.st_size, found.st_ino


def with_fields(file: ScanFile, given: Mapping[str, Any]) -> ScanFile:
    """The file with the flats and darks that are `given` beside it (paths), and without frames that are to be left out,
    or flats and darks unlike the others. Errors: `InputError` for frames without data."""
    extra = {kind: given[name] for kind, name in ((FLAT, "flats"), (DARK, "darks")) if given.get(name) is not None}
    if extra and not file.has_given_fields:
        parts = [(kind, light_frames(path, NAMED[kind], kind)) for kind, path in extra.items()]
        stacks, kinds = together(str(file.path), [(PROJECTION, file.stacks[0]), *parts])
        more = kinds[file.stacks[0].shape[0] :]
        file = replace(file, stacks=(*file.stacks, *stacks[1:]), kinds=np.concatenate([file.kinds, more]))
    if given.get("leave_out") is not None:
        left = marked("--leave-out", given["leave_out"], len(file.kinds))
        kept = ~left[file.numbers(PROJECTION)]
        require(bool(kept.any()), "--leave-out must leave some projections, but it names them all.")
        divided = None if file.divided is None else file.divided[np.flatnonzero(kept)]
        kinds, exposures = np.where(left, INVALID, file.kinds), file.exposures[np.flatnonzero(kept)]
        file = replace(file, kinds=kinds, exposures=exposures, is_test=file.is_test[kept], divided=divided)
    begin = 0
    for stack in file.stacks:
        if isinstance(stack, h5py.Dataset):
            gaps = require_filled(stack, file.label, file.kinds[begin : begin + len(stack)] != INVALID)
            if gaps is not None:
                file = replace(file, marked=gaps if file.marked is None else gaps | (file.marked != 0))
        begin += stack.shape[0]
    return without_odd(file, is_told=given.get("leave_out") is not None)
