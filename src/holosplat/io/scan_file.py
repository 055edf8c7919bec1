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
from urllib.parse import unquote

import h5py
import numpy as np

from ..checks import InputError, UnsaidError, in_range, require, shaped, warn
from ..geometry import Views, rotation_y
from ..scan import ENERGY_RANGE_KEV, PIXEL_RANGE_M, Exposures, checked_distance
from ..units import ANGLE_UNITS, BEAM_RANGE_KEV, ENERGY_UNITS, LENGTH_UNITS, PLANCK_TIMES_C_KEV_M, TIME_UNITS
from .angles import tell_steps
from .hdf5 import Fields, attribute_text, open_hdf5
from .light import read_divided_light
from .nxtomo_geometry import CONE, DATA_NAMES, SHIFT, Entry
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
        group = _scan_group(file, Path(path), given.get("entry"))
        entry = Entry(Path(path), group, _frame_kinds(Fields(Path(path), group)), given)
        _say_unequal_times(entry)
        _require_no_two_missing(entry)
        views = _views(entry)
        psf_sigma, time = entry.optional(PSF_SIGMA, PIXEL_UNITS, "px"), entry.optional(TIME, TIME_UNITS, "s")
        energy, distance = _energies(entry), _distances(entry)
        split = entry.optional(SPLIT, PIXEL_UNITS, "")
        wrong = split[~np.isin(split, (0, 1))]
        require(len(wrong) == 0, f"{entry.label(SPLIT)} must hold 0 (train) or 1 (test), but it holds {wrong[:1]}.")
        require(bool((psf_sigma >= 0).all()), f"{entry.label(PSF_SIGMA)} must not be negative; correct it.")
        spread = entry.optional(ENERGY_SPREAD, ENERGY_UNITS, "keV") / energy
        data, mask = entry.need(*DATA_NAMES), entry.find(*MASKS)
        yield ScanFile(
            entry.path,
            entry.label(data),
            (entry.dataset(data),),
            entry.kinds,
            Exposures(views, energy, distance, psf_sigma, time, bandwidth=spread),
            split == 1,
            entry.flips(),
            shaped(entry.label(mask), entry.numbers(mask), views.shape) if mask else None,
            _read_provenance(group),
            entry.label(entry.find(*IMAGE_KEYS) or IMAGE_KEY),
            divided=read_divided_light(entry, entry.is_projection),
        )


def _scan_group(file: h5py.File, path: Path, wanted: str | None) -> h5py.Group:
    """The group of the scan: the one that is `wanted`, or /entry, or the file's default or only one with frames, at the
    top of the file or one below, as Diamond has them."""

    def holds_frames(item: Any) -> bool:
        return isinstance(item, h5py.Group) and any(isinstance(item.get(n), h5py.Dataset) for n in DATA_NAMES)

    found = list[str]()
    for name, group in file.items():
        if holds_frames(group):
            found.append(name)
        elif isinstance(group, h5py.Group):
            found += [f"{name}/{inner}" for inner, item in group.items() if holds_frames(item)]
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


def _say_unequal_times(entry: Entry) -> None:
    """A warning where flats or darks were exposed longer or shorter than the projections, by a `count_time` of each
    frame: flats divide by another amount of light, and dark current grows with time."""
    name = entry.find(*COUNT_TIMES)
    if name is None or (times := entry.numbers(name)).shape != entry.kinds.shape:
        return
    usual = float(np.median(times[entry.is_projection]))
    for kind, called in ((FLAT, "flats"), (DARK, "darks")):
        others = times[entry.kinds == kind]
        if len(others) and not np.isclose(np.median(others), usual, rtol=SAME_TIME):
            warn(
                f"{entry.label(name)}: {called} were exposed {np.median(others):.4g} s, but projections {usual:.4g} "
                "s; take frames of the same time, by --flats and --darks, unless the counts were scaled"
            )


def _require_no_two_missing(entry: Entry) -> None:
    """`InputError` that names all options at once, where a file says little; one missing dataset is named by itself."""
    names = {
        "energy_kev": (*ENERGIES, *WAVELENGTHS),
        "distance": DISTANCES,
        "pixel_size": [n.format(x) for n in PIXEL_SIZES for x in "xy"],
    }
    missing = [name for name, paths in names.items() if entry.given.get(name) is None and not entry.find(*paths)]
    if len(missing) > 1:
        require_said(str(entry.path), missing)


def _views(entry: Entry) -> Views:
    """The views, with the rays of a cone where the file or the distance of the source says so."""
    shifts = entry.optional(SHIFT, LENGTH_UNITS, "m", (2,))
    larger = _magnification(entry, "pixel_size", PIXEL_SIZES[:2])
    pixel_size = (said(entry.given, "pixel_size") or _pixel_sizes(entry)) / larger
    entry.tell_moves(float(np.min(pixel_size)))
    if entry.given.get("angles_deg") is not None or not entry.find(ROTATION):
        views = Views.of_pixels(_rotations_of_angles(entry), shifts, entry.shape, pixel_size)
        views = views if entry.find(SHIFT) else entry.about_axis(views)
    else:
        rotations = entry.per_frame(ROTATION, {}, "", (3, 3))
        try:
            views = Views.of_pixels(rotations, shifts, entry.shape, pixel_size)
        except InputError as error:
            raise InputError(f"{entry.label(ROTATION)}: {error}") from None
    if entry.find(CONE) and entry.given.get("source_distance") is None:
        return replace(views, sources=entry.per_frame(CONE, LENGTH_UNITS, "m"))
    return with_rays(views, entry.source()[1])


def _rotations_of_angles(entry: Entry) -> np.ndarray:
    if entry.given.get("angles_deg") is not None:
        return rotation_y(angles_of_projections(entry.given["angles_deg"], entry.is_projection))
    unsaid = {"angles_deg": np.zeros(entry.count)}
    name = entry.need(*ANGLES, way_out="say it by --angles FILE, or add it", stand_in=unsaid)
    if {"units", "unit"}.isdisjoint(entry.dataset(name).attrs):
        most = np.abs(entry.per_frame(name, {}, "")).max()
        require(
            most <= MOST_RADIANS,
            f"{entry.label(name)} must carry @units, without which it is in radians, but it reaches {most:g}; set "
            "@units to 'deg' if these are degrees.",
        )
        if most > 0:
            warn(f"{entry.label(name)} has no @units: its angles, up to {most:.4g}, are taken as radians")
    angles_deg = np.rad2deg(entry.per_frame(name, ANGLE_UNITS, "rad"))
    tell_steps(angles_deg, entry.label(name))
    return rotation_y(angles_deg)


def _pixel_sizes(entry: Entry) -> float | np.ndarray:
    """The pixel size [m], or those [n] of the projections; x and y must share them, and y alone is not enough."""
    for names in ((name.format("x"), name.format("y")) for name in PIXEL_SIZES):
        found = [name for name in names if entry.find(name)]
        if not found:
            continue
        sizes = [entry.per_frame(name, LENGTH_UNITS, "m") for name in found]
        for name, each in zip(found, sizes):
            for size in (each.min(), each.max()):
                in_range(entry.label(name), float(size), *PIXEL_RANGE_M, unit="metres")
        across, down = sizes[0], sizes[-1]
        require(
            found[0] == names[0],
            f"{entry.label(names[0])} must be there beside y_pixel_size ({down[0]:g} m), but it is missing; say the "
            "size of square pixels by --pixel-size, or add it.",
        )
        unequal = np.flatnonzero(~np.isclose(across, down, rtol=1e-6, atol=0))
        if len(unequal):
            raise InputError(
                f"{entry.label(names[0])} and {names[1].rsplit('/', 1)[1]} must be equal (square pixels), but they "
                f"are {across[unequal[0]]:g} m and {down[unequal[0]]:g} m; resample the frames first."
            )
        return float(across[0]) if np.allclose(across, across[0], rtol=1e-6, atol=0) else across
    missing = entry.label(PIXEL_SIZES[-1].format("x"))
    message = f"{missing} must be there, but it is missing; say it by --pixel-size, or add it."
    raise UnsaidError(message, stand_in("pixel_size"))


def _energies(entry: Entry) -> np.ndarray:
    """Photon energies [n] of the projections in keV; energies that differ only by rounding become one."""
    if (told := said(entry.given, "energy_kev")) is not None:
        return np.full(entry.count, told)
    name = entry.find(*ENERGIES, *WAVELENGTHS)
    name = name or entry.need(*ENERGIES, way_out="say it by --energy-kev, or add it", stand_in=stand_in("energy_kev"))
    of_waves = name in WAVELENGTHS
    values = entry.per_frame(name, *((LENGTH_UNITS, "m") if of_waves else (ENERGY_UNITS, "keV")))
    energies = PLANCK_TIMES_C_KEV_M / values if of_waves else values
    for energy in (energies.min(), energies.max()):
        in_range(entry.label(name), float(energy), *(BEAM_RANGE_KEV if of_waves else ENERGY_RANGE_KEV), "keV")
    same = np.allclose(energies, energies[0], rtol=1e-6, atol=0)
    return np.full(len(energies), energies[0]) if same else energies


def _distances(entry: Entry) -> np.ndarray:
    """Effective propagation distances [n] of the projections [m]."""
    told, larger = said(entry.given, "distance"), _magnification(entry, "distance", DISTANCES[:1])
    if told is not None:
        return np.full(entry.count, told) / larger
    name = entry.need(*DISTANCES, way_out="say it by --distance, or add it", stand_in=stand_in("distance"))
    distances = entry.per_frame(name, LENGTH_UNITS, "m") / larger
    for distance in (distances.min(), distances.max()):
        checked_distance(float(distance), entry.label(name))
    return distances


def _magnification(entry: Entry, quantity: str, effective: tuple[str, ...]) -> np.ndarray | float:
    """(R + z) / R of a source R before the sample, by which pixels and distance are divided; 1 for a parallel beam, and
    where the file has one of the `effective` names, or the quantity is said without the source."""
    told = said(entry.given, quantity) is not None
    if told and entry.given.get("source_distance") is None:
        return 1.0
    if not told and entry.find(*(name.format(axis) for name in effective for axis in "xy")):
        return 1.0
    return entry.magnification(DISTANCES[1])


def _read_provenance(entry: h5py.Group) -> dict[str, str]:
    group = entry.get(PROVENANCE)
    return {
        unquote(name): str(item.asstr(errors="replace")[()])
        for name, item in (group.items() if isinstance(group, h5py.Group) else ())
        if isinstance(item, h5py.Dataset) and h5py.check_string_dtype(item.dtype) and item.shape == ()
    }
