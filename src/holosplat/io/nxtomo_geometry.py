"""What NXtomo files of the ESRF's library say of the geometry beside ours: axis, source and transformations."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import h5py
import numpy as np

from ..checks import InputError, note, require, warn
from ..geometry import Views
from ..units import ANGLE_UNITS, LENGTH_UNITS, format_length, unit_factor
from .hdf5 import Fields, attribute_text
from .raw_file import magnified, said

FLIPS = ("instrument/detector/y_flipped", "instrument/detector/x_flipped")
SHIFT = "instrument/detector/shift"
CONE = "instrument/detector/source_distance"
"""From source to sample, of cones of rays; pixels and distances are then those of waves in parallel beams."""
AXIS = ("instrument/detector/x_rotation_axis_pixel_position", "instrument/detector/estimated_cor_from_motor")
"""Columns from the middle of a frame, as it is stored, to the axis."""
VIEW = "instrument/detector/field_of_view"
PIXELS = ("px", "pixel", "pixels", "")
SOURCES = ("instrument/source/distance", "sample/source_distance", "source/distance")
MOVES = tuple(f"sample/{axis}_translation" for axis in "xyz")
TRANSFORMATIONS = "instrument/detector/transformations"
COORDINATES = "NeXus_Coordinate_System"


def flips_of(fields: Fields) -> tuple[bool, bool]:
    """Whether the stored frames are upside down, and mirrored: by their flags, or by half turns of the detector.

    A half turn about the vertical mirrors, one about the horizontal turns upside down, one about the beam does both;
    the vertical is z, and the beam x, unless the file has McStas' axes. Errors: `InputError` for other turns.
    """
    flags = [bool(fields.numbers(name).any()) if fields.find(name) else False for name in FLIPS]
    turns = np.zeros(3, dtype=bool)
    for item in _chain(fields):
        if attribute_text(item.attrs.get("transformation_type")) != "rotation":
            continue
        label, unit = f"{fields.path}: {item.name}", attribute_text(item.attrs.get("units")) or "deg"
        angle = np.rad2deg(np.asarray(item, dtype=np.float64).reshape(-1) * unit_factor(label, unit, ANGLE_UNITS))
        axis = np.abs(np.asarray(item.attrs.get("vector", np.zeros(3)), dtype=np.float64).reshape(-1)) > 0.5
        half = np.isclose(angle % 360, 180)
        known = bool(np.isclose(angle % 180, 0).all() and (half.all() or not half.any())) and axis.sum() == 1
        require(
            known and len(axis) == 3,
            f"{label} turns the detector by {angle[0]:.4g} degrees, but only half turns about its axes are read; turn "
            "the frames upright, and take it out.",
        )
        turns ^= axis & bool(half.all())
    mcstas = (attribute_text(fields.group.attrs.get(COORDINATES)) or "").lower() == "mcstas"
    across, up, along = turns if mcstas else turns[[1, 2, 0]]
    return bool(flags[0] ^ across ^ along), bool(flags[1] ^ up ^ along)


def _chain(fields: Fields) -> Iterator[h5py.Dataset]:
    """The transformations of the detector: from its `depends_on` from one to the next until ".", each once; where it
    has none, all of its group `transformations`."""
    detector, group = fields.group.get("instrument/detector"), fields.group.get(TRANSFORMATIONS)
    start = detector.get("depends_on") if isinstance(detector, h5py.Group) else None
    if not isinstance(start, h5py.Dataset) or start.shape != ():
        items = group.values() if isinstance(group, h5py.Group) else ()
        yield from (item for item in items if isinstance(item, h5py.Dataset))
        return
    parent, text, seen = detector, attribute_text(start[()]), set[str]()
    while isinstance(parent, h5py.Group) and text and text != ".":
        item = parent.get(text)
        if not isinstance(item, h5py.Dataset) or item.name in seen:
            raise InputError(f"{fields.path}: {parent.name} depends on {text}, which is no transformation; correct it.")
        seen.add(str(item.name))
        yield item
        parent, text = item.parent, attribute_text(item.attrs.get("depends_on"))


def about_axis(fields: Fields, views: Views) -> Views:
    """The views about the axis that the file says, if it does. Errors: `InputError` for one beyond the frames."""
    name = fields.find(*AXIS)
    view = fields.group.get(VIEW)
    said = attribute_text(view[()]) if isinstance(view, h5py.Dataset) and view.shape == () else None
    if name is None and (said or "").lower() == "half":
        warn(f"{fields.label(VIEW)} says Half, but no axis is said; find it by holosplat align --axis-only")
    if name is None or not np.isfinite(values := fields.numbers(name)).all() or not values.any():
        return views
    require(
        values.size == 1 or bool(np.ptp(values) == 0),
        f"{fields.label(name)} must be one number, but it differs from frame to frame; write one, or {SHIFT} of each.",
    )
    width, mirrored = views.shape[1], flips_of(fields)[1]
    values = (
        values * fields.unit(name, {**LENGTH_UNITS, **dict.fromkeys(PIXELS, views.pixel_size)}, "px") / views.pixel_size
    )
    off = float(values.reshape(-1)[0]) * (-1 if mirrored else 1)
    column = 0.5 * (width - 1) + off
    require(
        -0.5 <= column <= width - 0.5,
        f"{fields.label(name)} must count columns from the middle of {width}, within {width / 2:g} of it, but it is "
        f"{values.reshape(-1)[0]:g}; correct it, or take it out and say where the axis is by --axis-column.",
    )
    note(f"{fields.label(name)}: the axis is at column {column:g} of {width}; --axis-column says otherwise")
    return views.about_column(column)


def tell_moves(fields: Fields, per_frame: Callable[[str], np.ndarray], pixel: float) -> None:
    """Warn of a sample that the file moves between the projections by half a pixel [m] or more: frames are read as if
    it stood still."""
    for name in MOVES:
        if not fields.find(name):
            continue
        moved = float(np.ptp(per_frame(name))) * fields.unit(name, LENGTH_UNITS, "m")
        if moved >= 0.5 * pixel:
            warn(
                f"{fields.label(name)} moves the sample by {format_length(moved)} between the projections, which is "
                "not read; shift the frames accordingly first"
            )


def source_before(fields: Fields, given: Mapping[str, Any]) -> tuple[str, float | None]:
    """How far [m] before the sample the source is, as it is given (`Told.source_distance`), or else as the file says,
    and what messages call it; None where neither says it."""
    if (told := given.get("source_distance")) is not None:
        return "--source-distance", told
    if (name := fields.find(*SOURCES)) is None:
        return "", None
    source = np.abs(fields.numbers(name).reshape(-1)) * fields.unit(name, LENGTH_UNITS, "m")
    there = np.isfinite(source).all() and source.all() and len(source) > 0
    return fields.label(name), float(source[0]) if there else None


def magnification(
    fields: Fields, per_frame: Callable[[str], np.ndarray], detector: str, given: Mapping[str, Any]
) -> np.ndarray | float:
    """(R + z) / R of a source R before the sample, and the detector z behind it, [n] or one number; both as they are
    given, or else as the file says. Errors: `InputError` for a distance that cannot be.
    """
    (label, before), told = source_before(fields, given), given.get("source_distance") is not None
    if before is None or not (told or fields.find(detector)):
        return 1.0
    behind = said(given, "distance") if told else None
    if behind is None:
        behind = np.abs(per_frame(fields.need(detector))) * fields.unit(detector, LENGTH_UNITS, "m")
    data, size = fields.find("instrument/detector/data", "data/data"), fields.find("instrument/detector/x_pixel_size")
    pixel = said(given, "pixel_size") if told else None
    if pixel is None and size is not None:
        pixel = float(fields.numbers(size).reshape(-1)[0]) * fields.unit(size, LENGTH_UNITS, "m")
    shape = fields.dataset(data).shape[1:] if data is not None and pixel is not None else (0, 0)
    return magnified(label, before, behind, pixel or 0.0, shape)
