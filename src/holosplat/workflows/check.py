"""`check`: whether files are as they were written."""

from __future__ import annotations

from pathlib import Path

import h5py

from ..checks import InputError, require
from ..io.hdf5 import open_hdf5
from .provenance import MANIFEST, faults
from .run_folder import RunFolder

ROWS = 64
"""Rows of a dataset that are read at a time."""


def check(path: Path) -> tuple[int, list[str]]:
    """How many files there are at `path`, an HDF5 file or a folder, and what is wrong, a sentence each.

    A run folder is compared with its manifest; values of HDF5 files are read, which verifies their checksums where they
    have any. Errors: `InputError` where there is nothing that could be checked.
    """
    require(path.exists(), f"{path} must be a file or a folder, but there is nothing; check the path.")
    if path.is_file():
        return 1, _faults_of_values(path)
    run = RunFolder(path)
    files = [file for file in sorted(path.rglob("*")) if file.is_file() and h5py.is_hdf5(file)]
    wrong = faults(path, run.name()) if run.config.is_file() or (path / MANIFEST).is_file() else []
    require(bool(files) or run.config.is_file(), f"{path} must hold a run or HDF5 files, but it holds none.")
    return len(files), wrong + [fault for file in files for fault in _faults_of_values(file)]


def _faults_of_values(path: Path) -> list[str]:
    """What is wrong with an HDF5 file, if anything is."""
    try:
        with open_hdf5(path) as file:
            file.visititems(_read)
    except InputError as error:
        return [str(error)]
    return []


def _read(name: str, item: h5py.Group | h5py.Dataset) -> None:
    """Read all values of a dataset, a part at a time."""
    if not isinstance(item, h5py.Dataset) or item.shape is None:
        return
    if item.ndim == 0:
        item[()]
        return
    step = item.chunks[0] if item.chunks else ROWS
    for start in range(0, item.shape[0], step):
        item[start : start + step]
