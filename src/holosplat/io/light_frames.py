"""Flats and darks in files of their own (--flats, --darks), and frames of HDF5 datasets that have no data."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import h5py
import numpy as np
from h5py import h5p, h5s  # pyright: ignore[reportAttributeAccessIssue]  # compiled, without stubs

from ..checks import InputError, note, require
from .guard import read_archive
from .hdf5 import open_hdf5
from .hdf5_guard import chunks_of, opened_for_reading, virtual_places
from .stacks import ImageStack, stack_of

KEYS = ("image_key_control", "image_key")
FRAMES = re.compile("data|counts|frames|image", re.IGNORECASE)


@dataclass(frozen=True)
class DatasetStack:
    """Frames [n, H, W] of a dataset in an HDF5 file, which is opened anew for each.

    numbers: those of its frames that are taken.
    """

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
            return _dataset_stack(path, file, names, key)
    if path.suffix.lower() == ".npz" and path.is_file():
        return _of_archive(path, names)
    return stack_of(path)


def _dataset_stack(path: Path, file: h5py.File, names: str, key: int) -> DatasetStack:
    found: dict[str, h5py.Dataset] = {}

    def take(name: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset) and item.ndim in (2, 3) and item.dtype.kind in "iuf" and min(item.shape) > 0:
            found[name] = item

    file.visititems(take)  # each dataset once, whatever links lead to it
    name = _chosen(path, found, names)
    dataset = found[name]
    shape = (len(dataset) if dataset.ndim == 3 else 1, *dataset.shape[-2:])
    numbers = np.arange(shape[0])
    beside = cast(h5py.Group, dataset.parent)
    keys = next((beside[k] for k in KEYS if k in beside), None)
    if isinstance(keys, h5py.Dataset) and keys.shape == (shape[0],):
        marks = np.asarray(keys)
        numbers = next((n for mark in (key, 0) if len(n := np.flatnonzero(marks == mark))), numbers)
    require_filled(dataset, f"{path}: /{name}", np.isin(np.arange(shape[0]), numbers))
    return DatasetStack(path, name, tuple(numbers.tolist()), (len(numbers), shape[1], shape[2]))


def _of_archive(path: Path, names: str) -> np.ndarray:
    found = read_archive(path)
    frames = {name: array for name, array in found.items() if array.ndim in (2, 3) and array.dtype.kind in "iuf"}
    array = frames[_chosen(path, frames, names)]
    return array.reshape(-1, *array.shape[-2:])


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
    note(f"{label}: {int(gaps.sum())} pixels that no source fills count as defective")
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
