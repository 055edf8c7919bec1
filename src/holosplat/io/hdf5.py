"""HDF5 with clear messages, for the readers of scans and volumes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import h5py
import numpy as np
from h5py import h5d  # pyright: ignore[reportAttributeAccessIssue]  # compiled, without stubs

from ..checks import InputError, MissingError, UnsaidError, is_of_memory, require_regular, shaped
from ..units import unit_factor
from .guard import require_memory
from .hdf5_guard import WRITING, filters_missing_in, opened_for_reading, require_own
from .seal import require_sealed


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
        """The first of `names` that exists; `InputError`, with the advice `way_out`, when none does.

        stand_in: of an `UnsaidError`, where an option can say it.
        """
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
        if found.size and _is_unwritten(found):  # HDF5 would give zeros
            raise InputError(f"{self.label(name)} must be written, but it has no data; write it, or take it out.")
        require_memory(self.label(name), 8 * int(np.prod(found.shape, dtype=object)))
        return np.asarray(found[()], dtype=np.float64)

    def unit(self, name: str, table: dict[str, float], default: str) -> float:
        """The factor of the dataset's `@units` (or `@unit`) to the base unit of `table`; `default` when it has none."""
        said = self.dataset(name).attrs
        text = attribute_text(said.get("units", said.get("unit")))
        return unit_factor(self.label(name), default if text is None else text, table)


def _is_unwritten(dataset: h5py.Dataset) -> bool:
    """Whether a dataset holds nothing but the value that HDF5 gives where nobody said one."""
    plan = dataset.id.get_create_plist()
    held = plan.get_virtual_count() if dataset.is_virtual else dataset.id.get_storage_size()
    return held == 0 and plan.fill_value_defined() != h5d.FILL_VALUE_USER_DEFINED


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
