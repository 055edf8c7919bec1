"""NXtomo files, opened for reading: the kind and the exposure of each frame, and the frames one by one.

The names are those of docs/scan_files.md, and of the dialects of Diamond (`entry1/tomo_entry`) and the ESRF
(`entry0000`, nxtomo): where one quantity has several names, the first that a file has is read.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from ..checks import InputError, UnsaidError, finite, in_range, require, shaped, warn
from ..geometry import Views, rotation_y
from ..scan import ENERGY_RANGE_KEV, PIXEL_RANGE_M, Exposures, checked_distance
from ..units import ANGLE_UNITS, BEAM_RANGE_KEV, ENERGY_UNITS, LENGTH_UNITS, PLANCK_TIMES_C_KEV_M, TIME_UNITS
from .angles import tell_steps
from .hdf5 import Fields, attribute_text, open_hdf5
from .light import read_divided_light
from .nxtomo_geometry import CONE, SHIFT, about_axis, flips_of, magnification, source_before, tell_moves
from .nxtomo_geometry import FLIPS as FLIPS
from .raw_file import (
    DARK,
    FLAT,
    INVALID,
    NOTHING,
    PROJECTION,
    ScanFile,
    angles_of_projections,
    require_said,
    said,
    stand_in,
    with_rays,
)

DATA = "instrument/detector/data"
DATA_NAMES = (DATA, "data/data")
IMAGE_KEY = "instrument/detector/image_key"
IMAGE_KEYS = ("instrument/detector/image_key_control", IMAGE_KEY, "data/image_key")
MASK = "instrument/detector/pixel_mask"
MASKS = (MASK, "instrument/detector/detectorSpecific/pixel_mask", "instrument/detector/detector_specific/pixel_mask")
DETECTOR = "instrument/detector/"
PIXEL_SIZES = ("sample/{}_pixel_size", DETECTOR + "{}_magnified_pixel_size", DETECTOR + "{}_pixel_size")
"""Names of a pixel's size along x and y; those in the sample's plane come first."""
DISTANCES = ("sample/propagation_distance", "instrument/detector/distance")
ENERGIES = ("instrument/beam/incident_energy", "beam/incident_energy", "instrument/monochromator/energy")
WAVELENGTHS = ("instrument/beam/incident_wavelength", "beam/incident_wavelength", "instrument/monochromator/wavelength")
ANGLES = ("sample/rotation_angle", "data/rotation_angle")
ROTATION = "sample/view_rotation"
TIME = "sample/time"
COUNT_TIMES = (DETECTOR + "count_time", "control/count_time")
SAME_TIME = 0.01
"""Share by which times of exposure differ that were set alike."""
ENERGY_SPREAD = "instrument/beam/incident_energy_spread"
"""Full width at half maximum of the spectrum, in the unit of an energy (NXbeam)."""
PSF_SIGMA = "instrument/detector/psf_sigma"
SPLIT = "split"
PROVENANCE = "process/provenance"

PIXEL_UNITS = {"px": 1.0, "pixel": 1.0, "pixels": 1.0, "": 1.0}
ALIGNMENT = -1
"""Image key of frames at an angle seen before, which the ESRF takes to check for drift."""
MOST_RADIANS = 4 * np.pi
"""Angles without a unit are radians (the SI unit); beyond two turns they are degrees in all likelihood."""


@contextmanager
def open_scan(path: str | Path, given: Mapping[str, Any] = NOTHING) -> Iterator[ScanFile]:
    """An NXtomo file, checked except for its frames.

    given: values that go before the file's, by name (`TAKES`). Per-frame datasets may count all frames or the
    projections only. `InputError` names the file, the dataset, the allowed values and the value found.
    """
    with open_hdf5(path) as file:
        fields = Fields(Path(path), _entry(file, Path(path), given.get("entry")))
        kinds = _frame_kinds(fields)
        _say_unequal_times(fields, kinds)
        _require_no_two_missing(fields, given)
        views = _views(fields, kinds, given)
        psf_sigma = _optional(fields, kinds, PSF_SIGMA, PIXEL_UNITS, "px")
        time = _optional(fields, kinds, TIME, TIME_UNITS, "s")
        energy, distance = _energies(fields, kinds, given), _distances(fields, kinds, given)
        is_test = _split(fields, kinds)
        require(bool((psf_sigma >= 0).all()), f"{fields.label(PSF_SIGMA)} must not be negative; correct it.")
        spread = _optional(fields, kinds, ENERGY_SPREAD, ENERGY_UNITS, "keV") / energy
        exposures = Exposures(views, energy, distance, psf_sigma, time, bandwidth=spread)
        flips = flips_of(fields)
        data = fields.need(*DATA_NAMES)
        yield ScanFile(
            *(Path(path), fields.label(data), (fields.dataset(data),), kinds, exposures, is_test),
            *(flips, _marked(fields, views.shape), _read_provenance(fields)),
            fields.label(fields.find(*IMAGE_KEYS) or IMAGE_KEY),
            divided=read_divided_light(fields, kinds == PROJECTION),
        )


def _entry(file: h5py.File, path: Path, wanted: str | None) -> h5py.Group:
    """The group of the scan: the one that is `wanted`, or /entry, or the file's default or only one with frames."""
    found = _scans_in(file)
    if wanted is not None:
        group = file.get(wanted)
        if not isinstance(group, h5py.Group):
            raise InputError(f"{path} has no group {wanted}; --entry must be one of {', '.join(found) or 'none'}.")
        return group
    for name in ("entry", attribute_text(file.attrs.get("default")) or "entry", *(found if len(found) == 1 else ())):
        group = file.get(name)
        if isinstance(group, h5py.Group) and (name in found or not found):
            return group
    if found:
        raise InputError(f"{path} holds several scans; choose one by --entry: {', '.join(found)}.")
    raise InputError(
        f"{path} must hold the group /entry (NeXus NXtomo), but it holds {', '.join(file) or 'nothing'}; frames are "
        f"looked for as {' or '.join(DATA_NAMES)} in a group, or a group in that."
    )


def _scans_in(file: h5py.File) -> list[str]:
    """The groups that hold frames: at the top of the file, or one below, as Diamond has them."""
    found = []
    for name, group in file.items():
        if not isinstance(group, h5py.Group):
            continue
        inner = [f"{name}/{n}" for n, item in group.items() if isinstance(item, h5py.Group) and _holds_frames(item)]
        found += [name] if _holds_frames(group) else inner
    return found


def _holds_frames(group: h5py.Group) -> bool:
    return any(isinstance(group.get(name), h5py.Dataset) for name in DATA_NAMES)


def _frame_kinds(fields: Fields) -> np.ndarray:
    """The image key of each of all N frames, [N] int; checks the frames' shape too."""
    name = fields.need(*DATA_NAMES)
    data = fields.dataset(name)
    if data.ndim != 3 or 0 in data.shape:
        raise InputError(f"{fields.label(name)} must have the shape [N, H, W], but it has {data.shape}.")
    key = fields.find(*IMAGE_KEYS)
    if key is None:
        return np.full(len(data), PROJECTION)
    kinds = shaped(fields.label(key), fields.numbers(key), (len(data),))
    if key == IMAGE_KEYS[0]:
        kinds[kinds == ALIGNMENT] = INVALID
    known = np.isin(kinds, (PROJECTION, FLAT, DARK, INVALID))
    if not known.all():
        wrong = kinds[~known][0]
        raise InputError(
            f"{fields.label(key)} must hold 0 (projection), 1 (flat), 2 (dark) or 3 (invalid), but it holds {wrong:g}."
        )
    if not (kinds == PROJECTION).any():
        raise InputError(f"{fields.label(key)} must mark at least one projection (0), but it marks none.")
    return kinds.astype(int)


def _say_unequal_times(fields: Fields, kinds: np.ndarray) -> None:
    """A warning where flats or darks were exposed longer or shorter than the projections, by a `count_time` of each
    frame: flats divide by another amount of light, and dark current grows with time."""
    name = fields.find(*COUNT_TIMES)
    if name is None or (times := fields.numbers(name)).shape != kinds.shape:
        return
    usual = float(np.median(times[kinds == PROJECTION]))
    for kind, called in ((FLAT, "flats"), (DARK, "darks")):
        others = times[kinds == kind]
        if len(others) and not np.isclose(np.median(others), usual, rtol=SAME_TIME):
            warn(
                f"{fields.label(name)}: {called} were exposed {np.median(others):.4g} s, but projections {usual:.4g} "
                "s; take frames of the same time, by --flats and --darks, unless the counts were scaled"
            )


def _require_no_two_missing(fields: Fields, given: Mapping[str, Any]) -> None:
    """`InputError` that names all options at once, where a file says little; one missing dataset is named by itself."""
    names = {
        "energy_kev": (*ENERGIES, *WAVELENGTHS),
        "distance": DISTANCES,
        "pixel_size": [n.format(x) for n in PIXEL_SIZES for x in "xy"],
    }
    missing = [name for name, paths in names.items() if given.get(name) is None and not fields.find(*paths)]
    if len(missing) > 1:
        require_said(str(fields.path), missing)


def _marked(fields: Fields, shape: tuple[int, int]) -> np.ndarray | None:
    """`pixel_mask` [H, W] of NXdetector as stored, if there is one."""
    name = fields.find(*MASKS)
    return shaped(fields.label(name), fields.numbers(name), shape) if name else None


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


def _views(fields: Fields, kinds: np.ndarray, given: Mapping[str, Any]) -> Views:
    views = _placed(fields, kinds, given)
    if fields.find(CONE) and given.get("source_distance") is None:
        return replace(views, sources=_per_frame(fields, kinds, CONE) * fields.unit(CONE, LENGTH_UNITS, "m"))
    return with_rays(views, source_before(fields, given)[1])


def _placed(fields: Fields, kinds: np.ndarray, given: Mapping[str, Any]) -> Views:
    """The views with parallel rays."""
    shape = fields.dataset(fields.need(*DATA_NAMES)).shape[1:]
    shifts = _optional(fields, kinds, SHIFT, LENGTH_UNITS, "m", (2,))
    larger = _magnification(fields, kinds, given, "pixel_size", PIXEL_SIZES[:2])
    pixel_size = (said(given, "pixel_size") or _pixel_sizes(fields, kinds)) / larger
    tell_moves(fields, lambda name: _per_frame(fields, kinds, name), float(np.min(pixel_size)))
    if given.get("angles_deg") is not None or not fields.find(ROTATION):
        views = Views.of_pixels(_rotations_of_angles(fields, kinds, given), shifts, shape, pixel_size)
        return views if fields.find(SHIFT) else about_axis(fields, views)
    rotations = _per_frame(fields, kinds, ROTATION, (3, 3))
    try:
        return Views.of_pixels(rotations, shifts, shape, pixel_size)
    except InputError as error:
        raise InputError(f"{fields.label(ROTATION)}: {error}") from None


def _rotations_of_angles(fields: Fields, kinds: np.ndarray, given: Mapping[str, Any]) -> np.ndarray:
    if given.get("angles_deg") is not None:
        return rotation_y(angles_of_projections(given["angles_deg"], kinds == PROJECTION))
    unsaid = {"angles_deg": np.zeros(int((kinds == PROJECTION).sum()))}
    name = fields.need(*ANGLES, way_out="say it by --angles FILE, or add it", stand_in=unsaid)
    angles = _per_frame(fields, kinds, name)
    if {"units", "unit"}.isdisjoint(fields.dataset(name).attrs):
        require(
            np.abs(angles).max() <= MOST_RADIANS,
            f"{fields.label(name)} must carry @units, without which it is in radians, but it reaches "
            f"{np.abs(angles).max():g}; set @units to 'deg' if these are degrees.",
        )
        if angles.any():
            most = np.abs(angles).max()
            warn(f"{fields.label(name)} has no @units: its angles, up to {most:.4g}, are taken as radians")
    angles_deg = np.rad2deg(angles * fields.unit(name, ANGLE_UNITS, "rad"))
    tell_steps(angles_deg, fields.label(name))
    return rotation_y(angles_deg)


def _pixel_sizes(fields: Fields, kinds: np.ndarray) -> float | np.ndarray:
    """The pixel size [m], or those [n] of the projections; x and y must share them, and y alone is not enough."""
    for names in ((name.format("x"), name.format("y")) for name in PIXEL_SIZES):
        found = [name for name in names if fields.find(name)]
        if not found:
            continue
        sizes = [_per_frame(fields, kinds, name) * fields.unit(name, LENGTH_UNITS, "m") for name in found]
        for name, each in zip(found, sizes):
            for size in (each.min(), each.max()):
                in_range(fields.label(name), float(size), *PIXEL_RANGE_M, unit="metres")
        across, down = sizes[0], sizes[-1]
        require(
            found[0] == names[0],
            f"{fields.label(names[0])} must be there beside y_pixel_size ({down[0]:g} m), but it is missing; say the "
            "size of square pixels by --pixel-size, or add it.",
        )
        unequal = np.flatnonzero(~np.isclose(across, down, rtol=1e-6, atol=0))
        if len(unequal):
            raise InputError(
                f"{fields.label(names[0])} and {names[1].rsplit('/', 1)[1]} must be equal (square pixels), but they "
                f"are {across[unequal[0]]:g} m and {down[unequal[0]]:g} m; resample the frames first."
            )
        return float(across[0]) if np.allclose(across, across[0], rtol=1e-6, atol=0) else across
    missing = fields.label(PIXEL_SIZES[-1].format("x"))
    said = f"{missing} must be there, but it is missing; say it by --pixel-size, or add it."
    raise UnsaidError(said, stand_in("pixel_size"))


def _energies(fields: Fields, kinds: np.ndarray, given: Mapping[str, Any]) -> np.ndarray:
    """Photon energies [n] of the projections in keV; energies that differ only by rounding become one."""
    told = said(given, "energy_kev")
    if told is not None:
        return np.full(int((kinds == PROJECTION).sum()), told)
    name = fields.find(*ENERGIES) or fields.find(*WAVELENGTHS)
    name = name or fields.need(*ENERGIES, way_out="say it by --energy-kev, or add it", stand_in=stand_in("energy_kev"))
    if name in WAVELENGTHS:
        energies = PLANCK_TIMES_C_KEV_M / (_per_frame(fields, kinds, name) * fields.unit(name, LENGTH_UNITS, "m"))
    else:
        energies = _per_frame(fields, kinds, name) * fields.unit(name, ENERGY_UNITS, "keV")
    for energy in (energies.min(), energies.max()):
        in_range(
            fields.label(name), float(energy), *(BEAM_RANGE_KEV if name in WAVELENGTHS else ENERGY_RANGE_KEV), "keV"
        )
    same = np.allclose(energies, energies[0], rtol=1e-6, atol=0)
    return np.full(len(energies), energies[0]) if same else energies


def _distances(fields: Fields, kinds: np.ndarray, given: Mapping[str, Any]) -> np.ndarray:
    told = said(given, "distance")
    larger = _magnification(fields, kinds, given, "distance", DISTANCES[:1])
    if told is not None:
        return np.full(int((kinds == PROJECTION).sum()), told) / larger
    distances = _distances_of_file(fields, kinds) / larger
    for distance in (distances.min(), distances.max()):
        checked_distance(float(distance), fields.label(fields.find(*DISTANCES) or ""))
    return distances


def _distances_of_file(fields: Fields, kinds: np.ndarray) -> np.ndarray:
    name = fields.need(*DISTANCES, way_out="say it by --distance, or add it", stand_in=stand_in("distance"))
    return _per_frame(fields, kinds, name) * fields.unit(name, LENGTH_UNITS, "m")


def _magnification(
    fields: Fields, kinds: np.ndarray, given: Mapping[str, Any], quantity: str, effective: tuple[str, ...]
) -> np.ndarray | float:
    """(R + z) / R of a source R before the sample, by which pixels and distance are divided; 1 for a parallel beam, and
    where the file has one of the `effective` names, or the quantity is said without the source."""
    told = said(given, quantity) is not None
    if told and given.get("source_distance") is None:
        return 1.0
    if not told and fields.find(*(name.format(axis) for name in effective for axis in "xy")):
        return 1.0
    return magnification(fields, lambda name: _per_frame(fields, kinds, name), DISTANCES[1], given)


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
