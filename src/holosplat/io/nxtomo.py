"""Scans from and to NeXus NXtomo files (HDF5): the table in docs/conventions.md, and nothing else."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import h5py
import numpy as np

from .. import __version__
from ..checks import InputError, finite, in_range, require, shaped
from ..geometry import Views, rotation_y
from ..scan import DISTANCE_RANGE_M, ENERGY_RANGE_KEV, PIXEL_RANGE_M, Exposures, Scan
from ..units import ANGLE_UNITS, ENERGY_UNITS, LENGTH_UNITS, TIME_UNITS
from .atomic import atomic_path
from .hdf5 import Fields, attribute_text, open_hdf5

DATA = "instrument/detector/data"
IMAGE_KEY = "instrument/detector/image_key"
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


def read_scan(path: str | Path) -> Scan:
    """The projections of an NXtomo file, flat-field corrected, and how they were taken.

    Frames marked flat and dark correct the others: (frame - mean dark) / (mean flat - mean dark); frames
    marked invalid are dropped. Per-frame datasets may count all frames or the projections only. `InputError`
    names the file, the dataset, what it must be and what it is.
    """
    with open_hdf5(path) as file:
        fields = Fields(Path(path), _entry(file, path))
        kinds = _frame_kinds(fields)
        frames = _corrected_frames(fields, kinds)
        views = _views(fields, kinds, frames.shape[1:])
        psf_sigma = _optional(fields, kinds, PSF_SIGMA, PIXEL_UNITS, "px")
        time = _optional(fields, kinds, TIME, TIME_UNITS, "s")
        energy, distance = _energy(fields, kinds), _distances(fields, kinds)
        is_test = _split(fields, kinds)
        require(bool((psf_sigma >= 0).all()), f"{fields.label(PSF_SIGMA)} must not be negative; correct it.")
        exposures = Exposures(views, energy, distance, psf_sigma, time)
        return Scan(frames, exposures, is_test, _read_provenance(fields))


def write_scan(path: str | Path, scan: Scan) -> None:
    """Write `scan` as NXtomo (docs/conventions.md), replacing `path` only once all is written."""
    with scan_writer(path, scan.exposures, scan.is_test, scan.provenance) as add:
        for frame in scan.frames:
            add(frame)


@contextmanager
def scan_writer(
    path: str | Path, exposures: Exposures, is_test: np.ndarray, provenance: dict[str, str]
) -> Iterator[Callable[[np.ndarray], None]]:
    """A scan file that grows frame by frame: yields a function that takes the next frame, [H, W] relative intensity.

    The file appears at `path` when the block ends and all frames are there, and not at all when the block raises
    (Ctrl-C too): no frame is kept in memory. is_test: [N] bool. `view_rotation` holds the poses exactly;
    `rotation_angle`, which other programs read, the nearest rotation about y. Provenance goes to
    /entry/process/provenance, one text a dataset. Errors: `InputError` for frames of another shape, not finite,
    or not as many as there are exposures, and where the file cannot be written.
    """
    for key, value in provenance.items():
        good = isinstance(key, str) and isinstance(value, str) and key and "\0" not in key + value
        require(bool(good), f"provenance must map names to texts, but {key!r} maps to {value!r}; correct it.")
    is_test = shaped("split", np.asarray(is_test, dtype=bool), (len(exposures),))
    count = 0
    with atomic_path(path) as temporary, h5py.File(temporary, "w") as file:
        data = _write_entry(file, exposures, is_test, provenance)

        def add(frame: np.ndarray) -> None:
            nonlocal count
            require(count < len(data), f"a scan of {len(data)} exposures takes as many frames, but there are more.")
            data[count] = finite("frames", shaped("frame", np.asarray(frame), exposures.views.shape))
            count += 1

        yield add
        require(count == len(data), f"a scan of {len(data)} exposures needs as many frames, but there are {count}.")


def _write_entry(
    file: h5py.File, exposures: Exposures, is_test: np.ndarray, provenance: dict[str, str]
) -> h5py.Dataset:
    """All of a scan file but its frames, whose dataset is returned."""
    file.attrs.update(NX_class="NXroot", default="entry", creator=f"holosplat {__version__}")
    entry = _group(file, "entry", "NXentry", default="data")
    entry["definition"] = "NXtomo"
    entry[SPLIT] = is_test.astype(np.uint8)
    data = _write_instrument(_group(entry, "instrument", "NXinstrument"), exposures)
    _write_sample(_group(entry, "sample", "NXsample"), exposures)
    _write_process(_group(entry, "process", "NXprocess"), provenance)
    plot = _group(entry, "data", "NXdata", signal="data", axes=["rotation_angle", ".", "."])
    for source in (DATA, IMAGE_KEY, ANGLE):
        entry[source].attrs["target"] = f"/entry/{source}"
        plot[source.rsplit("/", 1)[1]] = entry[source]
    return data


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
    """What each of all N frames is (the image key), [N] int; checks the frames' shape on the way."""
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


def _corrected_frames(fields: Fields, kinds: np.ndarray) -> np.ndarray:
    """The projections [n, H, W] float32, relative to the flat field where the file has one."""
    data = fields.dataset(DATA)
    flat, dark = _mean_frame(data, kinds == FLAT), _mean_frame(data, kinds == DARK)
    if flat is None and dark is not None:
        raise InputError(f"{fields.label(IMAGE_KEY)} must mark flats (1) beside the dark ones (2), but it marks none.")
    offset = np.zeros(data.shape[1:]) if dark is None else dark
    gain = np.ones(data.shape[1:]) if flat is None else flat - offset
    dead = int((~(gain > 0)).sum())
    require(
        dead == 0,
        f"{fields.label(DATA)} must have flat frames brighter than dark ones everywhere, but in {dead} of "
        f"{gain.size} pixels they are not; repair these pixels first.",
    )
    selected = np.flatnonzero(kinds == PROJECTION)
    frames = np.empty((len(selected), *data.shape[1:]), dtype=np.float32)
    for i, n in enumerate(selected):  # one by one: the raw file may be larger than memory
        frames[i] = data[n] if flat is None else (data[n] - offset) / gain
    return finite(fields.label(DATA), frames)


def _mean_frame(data: h5py.Dataset, chosen: np.ndarray) -> np.ndarray | None:
    numbers = np.flatnonzero(chosen)
    if len(numbers) == 0:
        return None
    total = np.zeros(data.shape[1:])
    for n in numbers:
        total += data[n]
    return total / len(numbers)


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


def _energy(fields: Fields, kinds: np.ndarray) -> float:
    name = fields.need(*ENERGIES)
    energies = _per_frame(fields, kinds, name) * fields.unit(name, ENERGY_UNITS, "keV")
    if not np.allclose(energies, energies[0], rtol=1e-6, atol=0):
        raise InputError(
            f"{fields.label(name)} must be the same for all frames, but it goes from {energies.min():g} to "
            f"{energies.max():g} keV; split the scan by energy."
        )
    return in_range(fields.label(name), float(energies[0]), *ENERGY_RANGE_KEV, unit="keV")


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


def _group(parent: h5py.Group, name: str, nx_class: str, **attributes: str | list[str]) -> h5py.Group:
    group = parent.create_group(name)
    group.attrs["NX_class"] = nx_class
    group.attrs.update(attributes)
    return group


def _put(group: h5py.Group, name: str, value: np.ndarray | float, units: str) -> None:
    group[name] = value
    group[name].attrs["units"] = units


def _write_instrument(instrument: h5py.Group, exposures: Exposures) -> h5py.Dataset:
    source = _group(instrument, "source", "NXsource")
    source["probe"] = "x-ray"
    _put(_group(instrument, "beam", "NXbeam"), "incident_energy", float(exposures.energy_kev), "keV")
    detector = _group(instrument, "detector", "NXdetector")
    data = detector.create_dataset("data", (len(exposures), *exposures.views.shape), np.float32)
    detector["image_key"] = np.full(len(exposures), PROJECTION, dtype=np.int32)
    for axis in "xy":
        _put(detector, f"{axis}_pixel_size", exposures.views.pixel_size, "m")
    same = bool((exposures.distance == exposures.distance[0]).all())  # a scalar is what most programs expect
    _put(detector, "distance", exposures.distance[0] if same else exposures.distance, "m")
    _put(detector, "shift", exposures.views.shifts, "m")
    _put(detector, "psf_sigma", exposures.psf_sigma_px, "px")
    return data


def _write_sample(sample: h5py.Group, exposures: Exposures) -> None:
    sample["name"] = "sample"
    rotations = exposures.views.rotations
    sample["view_rotation"] = rotations
    # R(θ) is nearest to R where tr(R(θ)ᵀ R) = cos θ (R00 + R22) + sin θ (R02 - R20) is largest.
    theta = np.arctan2(rotations[:, 0, 2] - rotations[:, 2, 0], rotations[:, 0, 0] + rotations[:, 2, 2])
    _put(sample, "rotation_angle", np.rad2deg(theta), "deg")
    _put(sample, "time", exposures.time, "s")


def _write_process(process: h5py.Group, provenance: dict[str, str]) -> None:
    process["program"], process["version"] = "holosplat", __version__
    texts = _group(process, "provenance", "NXcollection")
    for key, value in provenance.items():
        texts[_escaped(key)] = value


def _escaped(key: str) -> str:
    """A provenance name as an HDF5 name, in which "/" and a lone "." have a meaning of their own."""
    escaped = key.replace("%", "%25").replace("/", "%2F")
    return escaped.replace(".", "%2E") if set(escaped) == {"."} else escaped


def _unescaped(name: str) -> str:
    return name.replace("%2E", ".").replace("%2F", "/").replace("%25", "%")
