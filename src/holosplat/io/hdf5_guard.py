"""HDF5 files that nobody vouches for: they bring their own values, not those of other files, and no more than they are.

A link, a virtual dataset or external storage can make a reader copy any file of this machine into what it writes.
"""

from __future__ import annotations

import errno
import os
import time
from collections.abc import Iterator
from pathlib import Path

import h5py
from h5py import h5d, h5l, h5o  # pyright: ignore[reportAttributeAccessIssue]  # compiled, without stubs

from ..checks import InputError, require, warn
from .guard import DEEPEST, require_declared
from .hdf5_chunks import require_chunks
from .hdf5_filters import unknown_filters
from .hdf5_sources import linked, require_external, virtual_sources
from .seal import require_sealed

MOST = 200_000
"""Links in a file, at most: larger ones are no scans, and take minutes to look through."""
MOST_FILES = 10_000
"""Files that one may bring values of: one a frame, and more than beamlines write."""
AGED = 1_000_000_000
"""Nanoseconds without a change after which the times of a file tell the next one: clocks of file systems are coarse."""
MOST_KNOWN = 1000
"""Files that are remembered, at most."""
WITHOUT_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)
"""What locking a file fails with where the file system has no locks."""
WRITING = (f"errno = {errno.EAGAIN},", f"errno = {errno.EACCES},", "already open for write")
"""What HDF5 says of a file that another program has open for writing, or left open as it ended."""
_vouched: set[Path] = set()
_known: dict[tuple[int, ...], None] = {}
"""Files that hold all that they are read for, by device, number, size and times: a command opens one several times."""


def opened_for_reading(path: Path) -> h5py.File:
    """The file at `path`, which nobody else may write meanwhile; on a file system without locks, without that.

    One that another program writes, or left open, is read as it is now, with a warning, where HDF5 can tell its parts.
    """
    try:
        return h5py.File(path, "r")
    except OSError as error:
        said = str(error)
        if any(f"errno = {number}," in said for number in WITHOUT_LOCKS):
            return h5py.File(path, "r", locking=False)
        if not any(words in said for words in WRITING):
            raise
    # SWMR: what a writer has flushed is whole, and its marks that the file is open do not count.
    opened = h5py.File(path, "r", locking=False, swmr=WRITING[-1] in said)
    warn(f"{path} is open for writing elsewhere, or was not closed; it is read as it is now")
    return opened


def allow_external(path: Path) -> None:
    """From now on `path`, or the files below it, may bring values of other files (`--allow-external`)."""
    _vouched.add(path.resolve())


def require_own(file: h5py.File, path: Path) -> None:
    """`InputError` if an open file at `path` refers to other files, is nested too deeply, or declares more values than
    it can hold. Where it may refer to others (`allow_external`), the same holds for each of these."""
    state = os.fstat(file.id.get_vfd_handle())
    stamp = (state.st_dev, state.st_ino, state.st_size, state.st_mtime_ns, state.st_ctime_ns)
    if stamp in _known:
        return
    allowed, now = is_vouched(path), time.time_ns()
    seen, later = {path.resolve()}, _others(file, path, allowed)
    if not allowed and now - max(state.st_mtime_ns, state.st_ctime_ns) > AGED:
        if len(_known) >= MOST_KNOWN:
            _known.clear()
        _known[stamp] = None
    while later:
        other = later.pop()
        if other.resolve() in seen:
            continue
        seen.add(other.resolve())
        require(len(seen) <= MOST_FILES, f"{path} must bring values of at most {MOST_FILES} files, but has more.")
        require_sealed(other)
        try:
            with opened_for_reading(other) as opened:
                later += _others(opened, other, allowed)
        except OSError as error:
            raise InputError(
                f"{other}, of which {path} brings values, must be a complete HDF5 file, but it is not: {error}."
            ) from None


def _others(file: h5py.File, path: Path, allowed: bool) -> list[Path]:
    """The HDF5 files that an open one refers to, once all else of it is in order."""
    size, found = path.stat().st_size, list[Path]()
    for name, kind in _links(file, path):
        label = f"{path}: /{name.decode(errors='replace')}"
        require(name.count(b"/") < DEEPEST, f"{path} must not be nested more than {DEEPEST} deep, but it is.")
        if kind == h5l.TYPE_EXTERNAL:
            require(allowed, _refers(path, name, "is a link to another file"))
            found += linked(path, label, file.id.links.get_val(name)[0])
        elif kind == h5l.TYPE_HARD and h5o.get_info(file.id, name).type == h5o.TYPE_DATASET:
            found += _dataset_files(h5d.open(file.id, name), path, name, allowed, size)
    return found


def _dataset_files(dataset: h5d.DatasetID, path: Path, name: bytes, allowed: bool, size: int) -> list[Path]:
    """The HDF5 files that a dataset of the file `path` refers to, once its values are in order."""
    label, plan = f"{path}: /{name.decode(errors='replace')}", dataset.get_create_plist()
    unknown_filters(plan)  # loads those that are installed; others are named where values are read
    if dataset.shape is None:  # a null dataspace holds nothing, which whoever wants a value says
        return []
    declared = dataset.get_type().get_size()
    for length in dataset.shape:
        declared *= length
    virtual, external = plan.get_layout() == h5d.VIRTUAL, plan.get_external_count() > 0
    others = virtual and any(plan.get_virtual_filename(n) != "." for n in range(plan.get_virtual_count()))
    require(allowed or not (others or external), _refers(path, name, "has its values in another file"))
    if virtual:
        return virtual_sources(path, label, plan, declared)
    if external:
        require_external(path, label, plan, declared)
    else:
        require_declared(label, declared, size)
        require_chunks(dataset, label, size)
    return []


def is_vouched(path: Path) -> bool:
    """Whether `path` may bring values of other files (`allow_external`)."""
    whole = path.resolve()
    return any(whole == known or known in whole.parents for known in _vouched)


def _refers(path: Path, name: bytes, what: str) -> str:
    return (
        f"{path} must hold its own values, but /{name.decode(errors='replace')} {what}; if you trust both, add "
        "--allow-external."
    )


def _links(file: h5py.File, path: Path) -> Iterator[tuple[bytes, int]]:
    """Names and kinds of all links in a file; links are not followed."""
    found: list[tuple[bytes, int]] = []

    def take(name: bytes, info: h5l.LinkInfo) -> bool | None:
        found.append((name, info.type))
        return True if len(found) > MOST else None

    file.id.links.visit(take, info=True)
    if len(found) > MOST:
        raise InputError(f"{path} must hold at most {MOST} entries, but it holds more.")
    return iter(found)
