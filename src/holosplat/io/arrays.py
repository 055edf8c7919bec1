"""Projections, flats and darks as arrays apart: plain ones, or those of data exchange.

Plain arrays are a NumPy archive (.npz), or an HDF5 file with datasets at its top: `counts` [N, H, W] are projections,
`flats` and `darks` [n, H, W] (or [H, W]) what corrects them, `angles_deg` [N] the angles; `energy_kev`, `distance` and
`pixel_size` [m] may stand beside them.

Data-exchange files of the Advanced Photon Source and its neighbours (HDF5) have the layout of De Carlo et al. (2014),
Journal of Synchrotron Radiation 21, 1224: `/exchange/data` [N, H, W], `data_white`, `data_dark`, and `theta` [N], in
degrees unless its unit says radians. What stands in `/measurement` is read where it is there: the energy of the
monochromator, the distance, the pixel size in the sample's plane.
"""

from __future__ import annotations

import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from ..checks import finite, require
from ..units import ANGLE_UNITS, ENERGY_UNITS, LENGTH_UNITS
from .angles import degrees
from .guard import read_archive
from .hdf5 import Fields, open_hdf5
from .raw_file import DARK, FLAT, NOTHING, PROJECTION, RANGES, ScanFile, Stack
from .stored_frames import raw_loader

FRAMES = ("counts", "projections", "proj", "data")
FLATS = ("flats", "flat", "white")
DARKS = ("darks", "dark")
ANGLES = ("angles_deg", "angles", "theta_deg")
NAMES = (*FRAMES, *FLATS, *DARKS, *ANGLES, *RANGES)


@contextmanager
def open_arrays(path: str | Path, given: Mapping[str, Any] = NOTHING) -> Iterator[ScanFile]:
    """An archive or HDF5 file of plain arrays, checked except for its frames; `given` and errors as of `open_scan`."""
    source = Path(path)
    with _arrays(source) as arrays:
        frames, flats, darks, angles = (_first(arrays, names) for names in (FRAMES, FLATS, DARKS, ANGLES))
        parts = [(PROJECTION, _stack(frames)), (FLAT, _stack(flats)), (DARK, _stack(darks))]
        found: dict[str, Any] = {}
        for name in (name for name in RANGES if name in arrays):
            count = arrays[name].size
            require(count == 1, f"{path}: {name} must be one number, but there are {count}; keep one.")
            found[name] = float(arrays[name][()].reshape(-1)[0])
        if angles is not None:
            name = next(name for name in ANGLES if name in arrays)
            found["angles_deg"] = finite(f"{path}: {name}", np.asarray(angles, dtype=np.float64).reshape(-1))
            if "deg" not in name:
                degrees(f"{path}: {name}", found["angles_deg"], f"by the name of the array, {ANGLES[0]}")
        yield ScanFile.of(source, parts, given, found)


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


def _stack(frames: Any) -> Stack | None:
    """Frames [n, H, W]; a single frame [H, W] is read and becomes one of them."""
    if frames is None or len(frames.shape) != 2:
        return frames
    return np.asarray(frames)[None]


def _holds_arrays(path: Path) -> bool:
    """Whether a file of HDF5 or NumPy holds such arrays."""
    if not path.is_file():
        return False
    if h5py.is_hdf5(path):
        with open_hdf5(path) as file:
            return any(_holds_values(file.get(name)) for name in FRAMES)
    if path.suffix.lower() != ".npz":
        return False
    if not zipfile.is_zipfile(path):
        return True  # damaged, which the reader says
    with zipfile.ZipFile(path) as archive:
        return any(f"{name}.npy" in archive.namelist() for name in FRAMES)


MARK = f"a NumPy archive (.npz) or an HDF5 file with the array {FRAMES[0]}"
LOADER = raw_loader("arrays", MARK, _holds_arrays, open_arrays)


DATA, WHITE, BLACK, THETA = (f"exchange/{name}" for name in ("data", "data_white", "data_dark", "theta"))
STACKS = ((PROJECTION, DATA), (FLAT, WHITE), (DARK, BLACK))
INSTRUMENT = "measurement/instrument"
ENERGIES = (f"{INSTRUMENT}/monochromator/energy",)
DISTANCES = (f"{INSTRUMENT}/detector_motor_stack/setup/camera_distance", f"{INSTRUMENT}/detector/distance")
PIXEL_SIZES = (
    f"{INSTRUMENT}/detection_system/objective/resolution",
    f"{INSTRUMENT}/detector/actual_pixel_size_x",
    f"{INSTRUMENT}/detector/x_actual_pixel_size",
)


@contextmanager
def open_exchange(path: str | Path, given: Mapping[str, Any] = NOTHING) -> Iterator[ScanFile]:
    """A data-exchange file, checked except for its frames; `given` and errors as of `open_scan`."""
    with open_hdf5(path) as file:
        fields = Fields(Path(path), file)
        parts = [(kind, _frames(fields, name)) for kind, name in STACKS]
        found = {
            "energy_kev": _number(fields, ENERGIES, ENERGY_UNITS, "keV"),
            "distance": _number(fields, DISTANCES, LENGTH_UNITS, "m"),
            "pixel_size": _number(fields, PIXEL_SIZES, LENGTH_UNITS, "m"),
            "angles_deg": _angles(fields),
        }
        yield ScanFile.of(Path(path), parts, given, found, fields.label(DATA), fields.label(WHITE))


def _frames(fields: Fields, name: str) -> h5py.Dataset | None:
    """The dataset `name` if it is there, and holds frames: some programs leave an empty one."""
    found = fields.dataset(name) if fields.find(name) else None
    return None if found is None or 0 in found.shape else found


def _number(fields: Fields, names: tuple[str, ...], table: dict[str, float], unit: str) -> float | None:
    """The first number above 0 of the datasets `names`, in the base unit of `table`; a length needs its unit."""
    for name in names:
        found = fields.group.get(name)
        if not isinstance(found, h5py.Dataset) or found.size != 1 or (unit == "m" and "units" not in found.attrs):
            continue
        value = float(fields.numbers(name).reshape(-1)[0]) * fields.unit(name, table, unit)
        if value > 0:
            return value
    return None


def _angles(fields: Fields) -> np.ndarray | None:
    """The angles [degrees]; without a unit they are degrees, as all programs of this format write them."""
    if not fields.find(THETA):
        return None
    if {"units", "unit"}.isdisjoint(fields.dataset(THETA).attrs):
        return degrees(fields.label(THETA), fields.numbers(THETA).reshape(-1), "by @units, 'rad' or 'deg'")
    return np.rad2deg(fields.numbers(THETA).reshape(-1) * fields.unit(THETA, ANGLE_UNITS, "deg"))


def _is_exchange(path: Path) -> bool:
    """Whether a file is one of data exchange."""
    if not (path.is_file() and h5py.is_hdf5(path)):
        return False
    with open_hdf5(path) as file:
        return isinstance(file.get(DATA), h5py.Dataset)


EXCHANGE = raw_loader("data-exchange", f"an HDF5 file with /{DATA}", _is_exchange, open_exchange)
