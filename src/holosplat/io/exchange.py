"""Data-exchange files of the Advanced Photon Source and its neighbours (HDF5): projections, flats and darks apart.

The layout is that of De Carlo et al. (2014), Journal of Synchrotron Radiation 21, 1224: `/exchange/data` [N, H, W],
`data_white`, `data_dark`, and `theta` [N], in degrees unless its unit says radians. What stands in `/measurement` is
read where it is there: the energy of the monochromator, the distance, the pixel size in the sample's plane.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from ..units import ANGLE_UNITS, ENERGY_UNITS, LENGTH_UNITS
from .hdf5 import Fields, open_hdf5
from .raw_file import DARK, FLAT, NOTHING, PROJECTION, RAW_TAKES, Loader, ScanFile, exposures_of, together
from .stored_frames import reader

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
    """A data-exchange file, checked except for its frames.

    given: values that go before the file's, by name (`TAKES`). Errors: `InputError` names the file, the dataset, and
    the option that says what is missing.
    """
    with open_hdf5(path) as file:
        fields = Fields(Path(path), file)
        stacks, kinds = together(str(path), [(kind, _frames(fields, name)) for kind, name in STACKS])
        found = {
            "energy_kev": _number(fields, ENERGIES, ENERGY_UNITS, "keV"),
            "distance": _number(fields, DISTANCES, LENGTH_UNITS, "m"),
            "pixel_size": _number(fields, PIXEL_SIZES, LENGTH_UNITS, "m"),
            "angles_deg": _angles(fields),
        }
        projections = kinds == PROJECTION
        own = {name: value for name, value in found.items() if given.get(name) is None}
        exposures = exposures_of(str(path), given, own, stacks[0].shape[1:], projections)  # type: ignore[arg-type]
        nothing_held_out = np.zeros(int(projections.sum()), dtype=bool)
        label, flats = fields.label(DATA), fields.label(WHITE)
        yield ScanFile(Path(path), label, stacks, kinds, exposures, nothing_held_out, kinds_label=flats)


def recognises(path: Path) -> bool:
    """Whether an HDF5 file is one of data exchange."""
    with open_hdf5(path) as file:
        return isinstance(file.get(DATA), h5py.Dataset)


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
    return np.rad2deg(fields.numbers(THETA).reshape(-1) * fields.unit(THETA, ANGLE_UNITS, "deg"))


def _recognises(path: Path) -> bool:
    return path.is_file() and h5py.is_hdf5(path) and recognises(path)


LOADER = Loader(
    *("data-exchange", f"an HDF5 file with /{DATA}", _recognises, reader(open_exchange), RAW_TAKES), opens=open_exchange
)
