"""NXtomo files, opened for reading: the kind and the exposure of each frame, and the frames one by one."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np

from ..checks import InputError, finite, in_range, require, shaped
from ..geometry import Views, rotation_y
from ..preprocess.flat_field import mean_frame
from ..scan import DISTANCE_RANGE_M, ENERGY_RANGE_KEV, PIXEL_RANGE_M, Exposures
from ..units import ANGLE_UNITS, ENERGY_UNITS, LENGTH_UNITS, TIME_UNITS
from .hdf5 import Fields, attribute_text, open_hdf5

DATA = "instrument/detector/data"
IMAGE_KEY = "instrument/detector/image_key"
MASK = "instrument/detector/pixel_mask"
FLIPS = ("instrument/detector/y_flipped", "instrument/detector/x_flipped")
PIXEL_SIZES = ("instrument/detector/x_pixel_size", "instrument/detector/y_pixel_size")
DISTANCES = ("sample/propagation_distance", "instrument/detector/distance")
ENERGIES = ("instrument/beam/incident_energy", "beam/incident_energy")
ANGLE = "sample/rotation_angle"
ROTATION = "sample/view_rotation"
SHIFT = "instrument/detector/shift"
TIME = "sample/time"
PSF_SIGMA = "instrument/detector/psf_sigma"
SPLIT = "split"
PROVENANCE = "process/provenance"

PROJECTION, FLAT, DARK, INVALID = range(4)
PIXEL_UNITS = {"px": 1.0, "pixel": 1.0, "pixels": 1.0, "": 1.0}
MOST_RADIANS = 4 * np.pi
"""Angles without a unit are radians (the SI unit); beyond two turns they are degrees in all likelihood."""


@dataclass(frozen=True)
class ScanFile:
    """An NXtomo file that is open: how its n projections were taken, and its N frames of all kinds, read one by one.

    kinds: [N], PROJECTION, FLAT, DARK or INVALID.
    exposures, is_test: of the projections.
    flips: whether the file's frames are upside down, and whether they are mirrored left to right.
    """

    fields: Fields
    kinds: np.ndarray
    exposures: Exposures
    is_test: np.ndarray
    flips: tuple[bool, bool]

    def numbers(self, kind: int) -> np.ndarray:
        """Which of the N frames are of `kind`."""
        return np.flatnonzero(self.kinds == kind)

    def frame(self, number: int) -> np.ndarray:
        """Frame `number` [H, W] as float64, turned upright."""
        return self.rows(number, slice(0, self.exposures.views.shape[0]))

    def rows(self, number: int, rows: slice) -> np.ndarray:
        """The rows `rows` (from start to stop) of frame `number`, float64, turned upright."""
        return upright(self.fields.dataset(DATA), number, rows, self.flips)

    def mean(self, kind: int) -> np.ndarray:
        """The mean [H, W] of the frames of `kind`; zeros where there are none."""
        return mean_frame((self.frame(n) for n in self.numbers(kind)), self.exposures.views.shape)

    def mask(self) -> np.ndarray:
        """[H, W] bool: the pixels that the file marks as defective (`pixel_mask` of NXdetector), turned upright."""
        shape = self.exposures.views.shape
        if not self.fields.find(MASK):
            return np.zeros(shape, dtype=bool)
        marked = shaped(self.fields.label(MASK), self.fields.numbers(MASK), shape) != 0
        return marked[:: -1 if self.flips[0] else 1, :: -1 if self.flips[1] else 1]

    def provenance(self) -> dict[str, str]:
        """The provenance of the scan."""
        return _read_provenance(self.fields)


def upright(data: h5py.Dataset, number: int, rows: slice, flips: tuple[bool, bool]) -> np.ndarray:
    """The rows `rows` (from start to stop) of frame `number` of `data` [N, H, W], float64, turned upright.

    flips: whether the stored frames are upside down, and mirrored left to right.
    """
    upside_down, mirrored = flips
    height = data.shape[1]
    stored = slice(height - rows.stop, height - rows.start) if upside_down else rows
    found = data[number, stored].astype(np.float64)
    return found[:: -1 if upside_down else 1, :: -1 if mirrored else 1]


@contextmanager
def open_scan(path: str | Path) -> Iterator[ScanFile]:
    """An NXtomo file, checked except for its frames.

    Per-frame datasets may count all frames or the projections only. `InputError` names the file, the dataset, the
    allowed values and the value found.
    """
    with open_hdf5(path) as file:
        fields = Fields(Path(path), _entry(file, path))
        kinds = _frame_kinds(fields)
        views = _views(fields, kinds, fields.dataset(DATA).shape[1:])
        psf_sigma = _optional(fields, kinds, PSF_SIGMA, PIXEL_UNITS, "px")
        time = _optional(fields, kinds, TIME, TIME_UNITS, "s")
        energy, distance = _energies(fields, kinds), _distances(fields, kinds)
        is_test = _split(fields, kinds)
        require(bool((psf_sigma >= 0).all()), f"{fields.label(PSF_SIGMA)} must not be negative; correct it.")
        exposures = Exposures(views, energy, distance, psf_sigma, time)
        flips = [bool(fields.numbers(name).any()) if fields.find(name) else False for name in FLIPS]
        yield ScanFile(fields, kinds, exposures, is_test, (flips[0], flips[1]))


def _entry(file: h5py.File, path: str | Path) -> h5py.Group:
    """/entry, or else the file's default or only NXentry group."""
    groups = {name: item for name, item in file.items() if isinstance(item, h5py.Group)}
    entries = [g for g in groups.values() if attribute_text(g.attrs.get("NX_class")) == "NXentry"]
    for name in ("entry", attribute_text(file.attrs.get("default"))):
        if name in groups:
            return groups[name]
    if len(entries) != 1:
        raise InputError(
            f"{path} must hold the group /entry (NeXus NXtomo), but it holds {', '.join(file) or 'nothing'}."
        )
    return entries[0]


def _frame_kinds(fields: Fields) -> np.ndarray:
    """The image key of each of all N frames, [N] int; checks the frames' shape too."""
    data = fields.dataset(fields.need(DATA))
    if data.ndim != 3 or 0 in data.shape:
        raise InputError(f"{fields.label(DATA)} must have the shape [N, H, W], but it has {data.shape}.")
    if not fields.find(IMAGE_KEY):
        return np.full(len(data), PROJECTION)
    kinds = shaped(fields.label(IMAGE_KEY), fields.numbers(IMAGE_KEY), (len(data),))
    known = np.isin(kinds, (PROJECTION, FLAT, DARK, INVALID))
    if not known.all():
        wrong = kinds[~known][0]
        raise InputError(
            f"{fields.label(IMAGE_KEY)} must hold 0 (projection), 1 (flat), 2 (dark) or 3 (invalid), "
            f"but it holds {wrong:g}."
        )
    if not (kinds == PROJECTION).any():
        raise InputError(f"{fields.label(IMAGE_KEY)} must mark at least one projection (0), but it marks none.")
    return kinds.astype(int)


def _per_frame(fields: Fields, kinds: np.ndarray, name: str, tail: tuple[int, ...] = ()) -> np.ndarray:
    """The dataset `name` for the projections, [n, *tail] float64, all finite; one value serves all."""
    values = fields.numbers(name)
    projections = np.flatnonzero(kinds == PROJECTION)
    if tail == () and values.size == 1:
        values = np.full(len(projections), values.reshape(-1)[0])
    elif values.shape == (len(kinds), *tail):
        values = values[projections]
    elif values.shape != (len(projections), *tail):
        one = "one value or " if tail == () else ""
        shape = ", ".join(str(n) for n in (len(kinds), *tail))
        raise InputError(
            f"{fields.label(name)} must hold {one}an entry for each frame, [{shape}], but its shape is "
            f"{list(values.shape)}."
        )
    return finite(fields.label(name), values)


def _optional(
    fields: Fields,
    kinds: np.ndarray,
    name: str,
    table: dict[str, float],
    unit: str,
    tail: tuple[int, ...] = (),
) -> np.ndarray:
    """The dataset `name` for the projections in the base unit of `table`; zeros [n, *tail] if absent."""
    if not fields.find(name):
        return np.zeros((int((kinds == PROJECTION).sum()), *tail))
    return _per_frame(fields, kinds, name, tail) * fields.unit(name, table, unit)


def _views(fields: Fields, kinds: np.ndarray, shape: tuple[int, int]) -> Views:
    shifts = _optional(fields, kinds, SHIFT, LENGTH_UNITS, "m", (2,))
    pixel_size = _pixel_size(fields)
    if not fields.find(ROTATION):
        return Views(_rotations_of_angles(fields, kinds), shifts, shape, pixel_size)
    rotations = _per_frame(fields, kinds, ROTATION, (3, 3))
    try:
        return Views(rotations, shifts, shape, pixel_size)
    except InputError as error:
        raise InputError(f"{fields.label(ROTATION)}: {error}") from None


def _rotations_of_angles(fields: Fields, kinds: np.ndarray) -> np.ndarray:
    angles = _per_frame(fields, kinds, fields.need(ANGLE))
    if "units" not in fields.dataset(ANGLE).attrs and np.abs(angles).max() > MOST_RADIANS:
        raise InputError(
            f"{fields.label(ANGLE)} must carry @units, without which it is in radians, but it reaches "
            f"{np.abs(angles).max():g}; set @units to 'deg' if these are degrees."
        )
    return rotation_y(np.rad2deg(angles * fields.unit(ANGLE, ANGLE_UNITS, "rad")))


def _pixel_size(fields: Fields) -> float:
    sizes = []
    for name in PIXEL_SIZES:
        if fields.find(name):
            number = shaped(fields.label(name), fields.numbers(name).reshape(-1), (1,))[0]
            size = number * fields.unit(name, LENGTH_UNITS, "m")
            sizes.append(in_range(fields.label(name), size, *PIXEL_RANGE_M, unit="metres"))
    if not sizes:
        fields.need(PIXEL_SIZES[0])
    if not np.isclose(sizes[0], sizes[-1], rtol=1e-6, atol=0):
        raise InputError(
            f"{fields.label(PIXEL_SIZES[0])} and y_pixel_size must be equal (square pixels), but they are "
            f"{sizes[0]:g} m and {sizes[1]:g} m; resample the frames first."
        )
    return sizes[0]


def _energies(fields: Fields, kinds: np.ndarray) -> np.ndarray:
    """Photon energies [n] of the projections in keV; energies that differ only by rounding become one."""
    name = fields.need(*ENERGIES)
    energies = _per_frame(fields, kinds, name) * fields.unit(name, ENERGY_UNITS, "keV")
    for energy in (energies.min(), energies.max()):
        in_range(fields.label(name), float(energy), *ENERGY_RANGE_KEV, unit="keV")
    same = np.allclose(energies, energies[0], rtol=1e-6, atol=0)
    return np.full(len(energies), energies[0]) if same else energies


def _distances(fields: Fields, kinds: np.ndarray) -> np.ndarray:
    name = fields.need(*DISTANCES)
    distances = _per_frame(fields, kinds, name) * fields.unit(name, LENGTH_UNITS, "m")
    for distance in (distances.min(), distances.max()):
        in_range(fields.label(name), float(distance), *DISTANCE_RANGE_M, unit="metres")
    return distances


def _split(fields: Fields, kinds: np.ndarray) -> np.ndarray:
    split = _optional(fields, kinds, SPLIT, PIXEL_UNITS, "")
    wrong = split[~np.isin(split, (0, 1))]
    require(len(wrong) == 0, f"{fields.label(SPLIT)} must hold 0 (train) or 1 (test), but it holds {wrong[:1]}.")
    return split == 1


def _read_provenance(fields: Fields) -> dict[str, str]:
    group = fields.group.get(PROVENANCE)
    if not isinstance(group, h5py.Group):
        return {}
    texts = {}
    for name, item in group.items():
        if isinstance(item, h5py.Dataset) and h5py.check_string_dtype(item.dtype) and item.shape == ():
            texts[_unescaped(name)] = item.asstr(errors="replace")[()]
    return texts


def _unescaped(name: str) -> str:
    return name.replace("%2E", ".").replace("%2F", "/").replace("%25", "%")
