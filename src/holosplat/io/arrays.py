"""Frames as plain arrays: a NumPy archive (.npz), or an HDF5 file with datasets at its top.

`counts` [N, H, W] are projections, `flats` and `darks` [n, H, W] (or [H, W]) what corrects them, `angles_deg` [N] the
angles; `energy_kev`, `distance` and `pixel_size` [m] may stand beside them.
"""

from __future__ import annotations

import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from ..checks import require
from .guard import read_archive
from .hdf5 import Fields, open_hdf5
from .raw_file import (
    DARK,
    FLAT,
    NOTHING,
    PROJECTION,
    RANGES,
    RAW_TAKES,
    Loader,
    ScanFile,
    Stack,
    exposures_of,
    together,
)
from .stored_frames import reader

FRAMES = ("counts", "projections", "proj", "data")
FLATS = ("flats", "flat", "white")
DARKS = ("darks", "dark")
ANGLES = ("angles_deg", "angles", "theta_deg")
NAMES = (*FRAMES, *FLATS, *DARKS, *ANGLES, *RANGES)


@contextmanager
def open_arrays(path: str | Path, given: Mapping[str, Any] = NOTHING) -> Iterator[ScanFile]:
    """An archive or HDF5 file of plain arrays, checked except for its frames.

    given: values that go before the file's, by name (`TAKES`). Errors: `InputError` for a damaged file, and for values
    that neither say, with the option that says them.
    """
    source = Path(path)
    with _arrays(source) as arrays:
        frames, flats, darks, angles = (_first(arrays, names) for names in (FRAMES, FLATS, DARKS, ANGLES))
        parts = [(PROJECTION, _stack(frames)), (FLAT, _stack(flats)), (DARK, _stack(darks))]
        stacks, kinds = together(str(path), parts)
        projections = kinds == PROJECTION
        found: dict[str, Any] = {} if angles is None else {"angles_deg": np.asarray(angles)}
        found |= {name: _number(f"{path}: {name}", arrays[name]) for name in RANGES if name in arrays}
        exposures = exposures_of(str(path), given, found, stacks[0].shape[1:], projections)  # type: ignore[arg-type]
        nothing_held_out = np.zeros(int(projections.sum()), dtype=bool)
        yield ScanFile(source, str(path), stacks, kinds, exposures, nothing_held_out, kinds_label=str(path))


@contextmanager
def _arrays(path: Path) -> Iterator[Mapping[str, Any]]:
    """The arrays of an archive, or the datasets of an open HDF5 file."""
    if h5py.is_hdf5(path):
        with open_hdf5(path) as file:
            fields = Fields(path, file)
            yield {name: fields.dataset(name) for name in NAMES if _holds_values(file.get(name))}
        return
    arrays = read_archive(path, NAMES)
    for name, array in arrays.items():
        require(array.dtype.kind in "iufb", f"{path}: {name} must hold numbers, but its type is {array.dtype}.")
    yield arrays


def _holds_values(item: Any) -> bool:
    """Whether it is a dataset; one with a null dataspace holds nothing."""
    return isinstance(item, h5py.Dataset) and item.shape is not None


def _first(arrays: Mapping[str, Any], names: tuple[str, ...]) -> Any:
    return next((arrays[name] for name in names if name in arrays), None)


def _number(label: str, array: Any) -> float:
    require(array.size == 1, f"{label} must be one number, but there are {array.size}; keep one.")
    return float(array[()].reshape(-1)[0])


def _stack(frames: Any) -> Stack | None:
    """Frames [n, H, W]; a single frame [H, W] is read and becomes one of them."""
    if frames is None or len(frames.shape) != 2:
        return frames
    return np.asarray(frames)[None]


def recognises(path: Path) -> bool:
    """Whether a file of HDF5 or NumPy holds such arrays."""
    if h5py.is_hdf5(path):
        with open_hdf5(path) as file:
            return any(_holds_values(file.get(name)) for name in FRAMES)
    if path.suffix.lower() != ".npz" or not zipfile.is_zipfile(path):
        return False
    with zipfile.ZipFile(path) as archive:
        return any(f"{name}.npy" in archive.namelist() for name in FRAMES)


def _recognises(path: Path) -> bool:
    return path.is_file() and recognises(path)


LOADER = Loader(
    "arrays",
    f"a NumPy archive (.npz) or an HDF5 file with the array {FRAMES[0]}",
    _recognises,
    reader(open_arrays),
    RAW_TAKES,
    open_arrays,
)
