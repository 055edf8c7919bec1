"""Frames of HDF5 datasets for which there is no data: HDF5 itself gives fill values for them, and says nothing."""

from __future__ import annotations

import math
from pathlib import Path

import h5py
import numpy as np
from h5py import h5p, h5s  # pyright: ignore[reportAttributeAccessIssue]  # compiled, without stubs

from ..checks import note, require
from .hdf5_chunks import chunks_of
from .hdf5_guard import opened_for_reading
from .hdf5_sources import virtual_places

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
