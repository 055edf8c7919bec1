"""Flats and darks in files of their own (--flats, --darks), of any format."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import h5py
import numpy as np

from ..checks import InputError, require
from .guard import read_archive
from .hdf5 import open_hdf5
from .hdf5_virtual import require_filled
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
