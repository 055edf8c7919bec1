"""New HDF5 files: whole or not at all, with checksums of their values and a seal, on disks that may be full."""

from __future__ import annotations

import io
import math
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from ..checks import require
from .atomic import atomic_path
from .provenance import ATTRIBUTE, attribute
from .seal import seal, summed

LARGE = 1 << 20
"""Bytes of a chunk, about: checksums are of chunks, and are read with them."""
SPARE = 1 << 20
"""Bytes beside the values for which there must be room."""


@contextmanager
def new_hdf5(path: str | Path, size: int = 0) -> Iterator[h5py.File]:
    """An HDF5 file to be written, which appears at `path` when the block ends well, and not at all when it raises.

    size: bytes that it will have at least, for which there must be room. A full disk is an `InputError`: HDF5 itself
    would write again after a failed close, and crash, and so it never hears of the failure.
    """
    with atomic_path(path) as temporary:
        require_room(path, size)
        with temporary.open("w+b", buffering=0) as raw:
            sink = _Sink(raw)
            with h5py.File(sink, "w") as file:
                yield file
                file.attrs[ATTRIBUTE] = attribute(Path(os.path.realpath(path)))
                ranges = summed(file)
            sink.settle()
            seal(raw, ranges)


def put(group: h5py.Group, name: str, values: Any) -> h5py.Dataset:
    """A new dataset of `values` with checksums; single numbers, texts and empty arrays stand for themselves."""
    array = np.asarray(values)
    if array.ndim == 0 or array.size == 0 or array.dtype.kind not in "iufb":
        return group.create_dataset(name, data=values)
    return room_for(group, name, array.shape, array.dtype, values=array)


def room_for(
    group: h5py.Group,
    name: str,
    shape: tuple[int, ...],
    dtype: Any,
    *,
    chunk: tuple[int, ...] | None = None,
    values: np.ndarray | None = None,
) -> h5py.Dataset:
    """A new dataset of this shape with checksums (Fletcher 1982), to be filled in parts as large as `chunk`."""
    chunk = chunk or _chunk(shape, np.dtype(dtype).itemsize)
    return group.create_dataset(name, shape, dtype, data=values, chunks=chunk, fletcher32=True)


def require_room(path: str | Path, size: int) -> None:
    """`InputError` unless the disk of `path` has room for a file of `size` bytes."""
    folder = Path(os.path.realpath(path)).parent
    free = os.statvfs(folder).f_frsize * os.statvfs(folder).f_bavail
    require(
        size == 0 or size + SPARE <= free,
        f"{path} needs {(size + SPARE) / 1e6:.0f} MB, but {folder} has {free / 1e6:.0f} MB left; make room, or write "
        "elsewhere.",
    )


def _chunk(shape: tuple[int, ...], itemsize: int) -> tuple[int, ...]:
    """Whole trailing axes, as many as fit into `LARGE`, and a part of the next one; at least one row."""
    chunk = list(shape)
    for axis in range(len(shape)):
        rest = itemsize * math.prod(chunk[axis + 1 :])
        chunk[axis] = max(1, min(shape[axis], LARGE // max(rest, 1)))
        if chunk[axis] > 1 or rest <= LARGE:
            break
    return tuple(chunk)


class _Sink(io.RawIOBase):
    """A file that goes on after its disk has failed, as if nothing were, and says so in the end."""

    def __init__(self, raw: io.FileIO) -> None:
        self._raw, self._failure = raw, None

    _raw: io.FileIO
    _failure: OSError | None

    def settle(self) -> None:
        """Raise what went wrong, if anything did."""
        if self._failure is not None:
            raise self._failure

    def _tried(self, action: Callable[[], Any], otherwise: int) -> int:
        if self._failure is not None:
            return otherwise
        try:
            done = action()
        except OSError as failure:
            self._failure = failure
            return otherwise
        return otherwise if done is None else int(done)

    def write(self, data: Any) -> int:
        """All of `data`, or none if the disk has failed; its length in either case."""
        view = memoryview(data).cast("B")

        def all_of_it() -> None:
            rest = view
            while len(rest):
                rest = rest[self._raw.write(rest) :]

        self._tried(all_of_it, 0)
        return len(view)

    def readinto(self, buffer: Any) -> int:
        """What is there, and zeros behind it."""
        view = memoryview(buffer).cast("B")
        count = self._tried(lambda: self._raw.readinto(view), 0)
        view[count:] = bytes(len(view) - count)
        return len(view)

    def seek(self, offset: int, whence: int = 0) -> int:
        """As of a file."""
        return self._tried(lambda: self._raw.seek(offset, whence), 0)

    def tell(self) -> int:
        """As of a file."""
        return self._tried(self._raw.tell, 0)

    def truncate(self, size: int | None = None) -> int:
        """As of a file."""
        return self._tried(lambda: self._raw.truncate(size), size or 0)

    def readable(self) -> bool:
        """It is."""
        return True

    def seekable(self) -> bool:
        """It is."""
        return True

    def writable(self) -> bool:
        """It is."""
        return True
