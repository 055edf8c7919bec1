"""Frames of HDF5 datasets for which there is no data: HDF5 itself gives fill values for them, and says nothing."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
from h5py import h5p, h5s  # pyright: ignore[reportAttributeAccessIssue]  # compiled, without stubs

from ..checks import require
from .hdf5_sources import virtual_places


def require_filled(dataset: h5py.Dataset, label: str, wanted: np.ndarray) -> None:
    """`InputError` if a virtual dataset [N, …] has no data for some of the frames `wanted` [N] bool."""
    if not dataset.is_virtual:
        return
    empty = np.flatnonzero(~_filled(dataset) & wanted)
    shown = ", ".join(map(str, empty[:8])) + (" …" if len(empty) > 8 else "")
    require(
        len(empty) == 0,
        f"{label} must have data for each frame, but for {len(empty)} of {len(dataset)} it has none ({shown}, counted "
        "from 0): its sources lack them. Bring the whole files, or leave these frames out by --leave-out.",
    )


def _filled(dataset: h5py.Dataset) -> np.ndarray:
    """[N] bool: whether each value of a frame is in the sources."""
    plan, frame = dataset.id.get_create_plist(), int(np.prod(dataset.shape[1:], dtype=object))
    held = np.zeros(len(dataset), dtype=np.int64)
    for number in range(plan.get_virtual_count()):
        space, source = plan.get_virtual_vspace(number), plan.get_virtual_srcspace(number)
        numbers = _frames_of(space, len(dataset))
        if numbers is None:  # it grows with its sources
            return np.ones(len(dataset), dtype=bool)
        there = _share(plan, number, source, space.get_select_npoints(), Path(dataset.file.filename))
        count = int(np.ceil(len(numbers) * there - 1e-9)) if 0 < there < 1 else len(numbers) * (there > 0)
        held[numbers[:count]] += space.get_select_npoints() // len(numbers)
    return held >= frame


def _frames_of(space: h5s.SpaceID, total: int) -> np.ndarray | None:
    """The numbers of the frames that a selection reaches; None where it has no end."""
    if space.get_select_type() == h5s.SEL_ALL:
        return np.arange(total)
    if space.is_regular_hyperslab():
        (start, *_), (stride, *_), (count, *_), (block, *_) = space.get_regular_hyperslab()
        if min(count, block) < 0 or max(count, block) >= h5s.UNLIMITED % 2**64:
            return None
        return (start + stride * np.arange(count)[:, None] + np.arange(block)).ravel()
    first, last = space.get_select_bounds()
    return np.arange(first[0], last[0] + 1)


def _share(plan: h5p.PropDCID, number: int, wanted: h5s.SpaceID, count: int, path: Path) -> float:
    """Which part of the `count` values that a mapping wants of its source is there, of those at its beginning."""
    name, dataset = plan.get_virtual_filename(number), plan.get_virtual_dsetname(number)
    for place in [path] if name == "." else virtual_places(path, name):
        with h5py.File(place, "r") as file:
            found = file.get(dataset)
            if not isinstance(found, h5py.Dataset) or found.shape is None:
                return 0.0
            if wanted.get_select_type() == h5s.SEL_ALL:
                return min(1.0, int(np.prod(found.shape, dtype=object)) / count)
            first, last = wanted.get_select_bounds()
            if len(first) != found.ndim or any(end >= size for end, size in zip(last[1:], found.shape[1:])):
                return 0.0
            return min(1.0, max(0.0, (found.shape[0] - first[0]) / (last[0] - first[0] + 1)))
    return 0.0
