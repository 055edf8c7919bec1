"""Texts that stand at the top of an HDF5 file and say where it belongs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from .hdf5 import open_hdf5


def read_marks(path: Path, names: Sequence[str]) -> dict[str, str]:
    """Those of the attributes `names` that the file has at its top. Errors: `InputError`."""
    with open_hdf5(path) as file:
        return {name: str(file.attrs[name]) for name in names if name in file.attrs}
