"""HDF5: files opened with clear messages, and new ones written whole or not at all, with checksums and a seal."""

from __future__ import annotations

import io
import math
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, cast

import h5py
import numpy as np
from h5py import h5d  # pyright: ignore[reportAttributeAccessIssue]  # compiled, without stubs

from ..checks import InputError, MissingError, UnsaidError, is_of_memory, require, require_regular, shaped
from ..units import unit_factor
from .atomic import atomic_path
from .guard import require_memory
from .hdf5_guard import WRITING, filters_missing_in, opened_for_reading, require_own, require_sealed, seal, summed
from .provenance import ATTRIBUTE, attribute


@contextmanager
def open_hdf5(path: str | Path) -> Iterator[h5py.File]:
    """`path` opened for reading; `InputError` when it is missing, no HDF5 file, truncated or damaged."""
    file = Path(path)
    require_regular(file, "an HDF5 file")
    try:
        require_sealed(file)
        if not h5py.is_hdf5(file):
            raise InputError(f"{path} must be an HDF5 file, but it does not start like one.")
        with opened_for_reading(file) as opened:
            require_own(opened, file)
            yield opened
    except (OSError, RuntimeError, KeyError) as error:
        if is_of_memory(error):
            raise MemoryError(f"{path}: {error}") from error
        if missing := filters_missing_in(file):
            raise MissingError(
                f"{path} is compressed by filters that HDF5 does not have here: {missing}; install them by pip install "
                '"holosplat[codecs]" (hdf5plugin), or write the file anew without them (h5repack -f GZIP=4).'
            ) from error
        if WRITING[-1] in str(error):
            raise InputError(
                f"{path} must be closed, but another program has it open for writing, or ended before it closed it; "
                "close it there, or run h5clear -s on a copy of it."
            ) from error
        raise InputError(
            f"{path} must be a complete HDF5 file, but it is truncated, damaged or not readable: {error}."
        ) from error


@dataclass(frozen=True)
class Fields:
    """The datasets below one group of the file `path`; messages name the file and the dataset."""

    path: Path
    group: h5py.Group

    def label(self, name: str) -> str:
        """How messages call the dataset `name` (below the group)."""
        return f"{self.path}: {self._below}/{name}"

    @property
    def _below(self) -> str:
        return (self.group.name or "").rstrip("/")

    def find(self, *names: str) -> str | None:
        """The first of `names` that exists, or None."""
        return next((name for name in names if name in self.group), None)

    def need(self, *names: str, way_out: str = "add it", stand_in: Mapping[str, Any] = MappingProxyType({})) -> str:
        """The first of `names` that exists; otherwise `InputError` with a `way_out`, or `UnsaidError` with
        `stand_in`."""
        found = self.find(*names)
        if found is None:
            others = "".join(f" (or {self._below}/{name})" for name in names[1:])
            said = f"{self.label(names[0])}{others} must be there, but it is missing; {way_out}."
            raise UnsaidError(said, stand_in) if stand_in else InputError(said)
        return found

    def dataset(self, name: str) -> h5py.Dataset:
        """The dataset `name`, if it is one and holds real numbers."""
        found = self.group.get(name)
        if not isinstance(found, h5py.Dataset):
            raise InputError(f"{self.label(name)} must be a dataset, but it is a group or a broken link.")
        if found.shape is None:
            raise InputError(
                f"{self.label(name)} must hold numbers, but it holds nothing (a null dataspace); write them, or take "
                "it out of the file."
            )
        if found.dtype.kind not in "iufb":
            raise InputError(f"{self.label(name)} must hold numbers, but its type is {found.dtype}.")
        return found

    def numbers(self, name: str) -> np.ndarray:
        """All of the dataset `name` as float64; `InputError` where none of it was ever written."""
        found = self.dataset(name)
        plan = found.id.get_create_plist()
        held = plan.get_virtual_count() if found.is_virtual else found.id.get_storage_size()
        require(
            found.size == 0 or held > 0 or plan.fill_value_defined() == h5d.FILL_VALUE_USER_DEFINED,
            f"{self.label(name)} must be written, but it has no data; write it, or take it out.",  # HDF5 gives zeros
        )
        require_memory(self.label(name), 8 * int(np.prod(found.shape, dtype=object)))
        return np.asarray(found[()], dtype=np.float64)

    def unit(self, name: str, table: dict[str, float], default: str) -> float:
        """The factor of the dataset's `@units` (or `@unit`) to the base unit of `table`; `default` when it has none."""
        said = self.dataset(name).attrs
        text = attribute_text(said.get("units", said.get("unit")))
        return unit_factor(self.label(name), default if text is None else text, table)


def attribute_text(value: Any) -> str | None:
    """An attribute as text, whichever of HDF5's string types it has; None for None, and for one that holds nothing."""
    if isinstance(value, h5py.Empty):
        return None
    if isinstance(value, np.ndarray):
        value = value.reshape(-1)[0] if value.size == 1 else str(value)
    if isinstance(value, bytes):
        value = value.decode("utf-8", errors="replace")
    return None if value is None else str(value)


def attribute_numbers(label: str, value: Any, counts: tuple[int, ...]) -> np.ndarray:
    """An attribute as float64 [n], n being one of `counts`; `InputError` otherwise."""
    array = np.asarray(value)
    if array.dtype.kind not in "iuf":
        text = attribute_text(value)
        raise InputError(f"{label} must hold numbers, but {'it holds nothing' if text is None else f'it is {text!r}'}.")
    array = array.astype(np.float64).reshape(-1)
    return array if array.size in counts else shaped(label, array, (counts[-1],))


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
    """A new dataset of this shape with checksums (Fletcher 1982), to be filled in parts as large as `chunk`: whole
    trailing axes, as many as fit into `LARGE`, and a part of the next one, where that is left out."""
    if chunk is None:
        parts, itemsize = list(shape), np.dtype(dtype).itemsize
        for axis in range(len(shape)):
            rest = itemsize * math.prod(shape[axis + 1 :])
            parts[axis] = max(1, min(shape[axis], LARGE // max(rest, 1)))
            if parts[axis] > 1 or rest <= LARGE:
                break
        chunk = tuple(parts)
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


class _Sink(io.RawIOBase):
    """A file that goes on after its disk has failed, as if nothing were, and says so in the end."""

    def __init__(self, raw: io.FileIO) -> None:
        self._raw, self._failure = raw, cast(OSError | None, None)

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

        rest = view
        while len(rest) and self._failure is None:
            rest = rest[self._tried(lambda part=rest: self._raw.write(part), 0) :]
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
