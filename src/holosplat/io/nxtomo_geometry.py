"""Fields of NXtomo files, frame by frame, and the geometry in those of the ESRF's library: axis, source, turns."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import h5py
import numpy as np

from ..checks import InputError, finite, note, require, warn
from ..geometry import Views
from ..units import ANGLE_UNITS, LENGTH_UNITS, format_length, unit_factor
from .hdf5 import Fields, attribute_text
from .raw_file import PROJECTION, magnified, said

DATA_NAMES = ("instrument/detector/data", "data/data")
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


@dataclass(frozen=True)
class Entry(Fields):
    """The fields of a scan whose N frames are of `kinds` [N], with the values that are `given` beside the file."""

    kinds: np.ndarray
    given: Mapping[str, Any]

    @property
    def is_projection(self) -> np.ndarray:
        """[N] bool: which frames are the n projections."""
        return self.kinds == PROJECTION

    @property
    def count(self) -> int:
        """The number n of projections."""
        return int(self.is_projection.sum())

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the frames."""
        return self.dataset(self.need(*DATA_NAMES)).shape[1:]

    def per_frame(self, name: str, table: dict[str, float], unit: str, tail: tuple[int, ...] = ()) -> np.ndarray:
        """The dataset `name` for the projections, [n, *tail] float64, all finite, in the base unit of `table` (`unit`
        where the file says none); one value serves all."""
        values, projections = self.numbers(name), self.is_projection
        if tail == () and values.size == 1:
            values = np.full(self.count, values.reshape(-1)[0])
        elif values.shape == (len(projections), *tail):
            values = values[projections]
        elif values.shape != (self.count, *tail):
            one = "one value or " if tail == () else ""
            shape = ", ".join(str(n) for n in (len(projections), *tail))
            raise InputError(
                f"{self.label(name)} must hold {one}an entry for each frame, [{shape}], but its shape is "
                f"{list(values.shape)}."
            )
        return finite(self.label(name), values) * (self.unit(name, table, unit) if table else 1.0)

    def optional(self, name: str, table: dict[str, float], unit: str, tail: tuple[int, ...] = ()) -> np.ndarray:
        """The same, or zeros [n, *tail] where the dataset is absent."""
        return self.per_frame(name, table, unit, tail) if self.find(name) else np.zeros((self.count, *tail))

    def source(self) -> tuple[str, float | None]:
        """The distance [m] from source to sample, given or in the file (else None), and what messages call it."""
        if (told := self.given.get("source_distance")) is not None:
            return "--source-distance", told
        if (name := self.find(*SOURCES)) is None:
            return "", None
        source = np.abs(self.numbers(name).reshape(-1)) * self.unit(name, LENGTH_UNITS, "m")
        there = np.isfinite(source).all() and source.all() and len(source) > 0
        return self.label(name), float(source[0]) if there else None

    def magnification(self, detector: str) -> np.ndarray | float:
        """(R + z) / R of a source R before the sample, and the detector z behind it, [n] or one number; both as they
        are given, or else as the file says (z as `detector`). Errors: `InputError` for a distance that cannot be.
        """
        (label, before), told = self.source(), self.given.get("source_distance") is not None
        if before is None or not (told or self.find(detector)):
            return 1.0
        behind, pixel = (said(self.given, name) if told else None for name in ("distance", "pixel_size"))
        if behind is None:
            behind = np.abs(self.per_frame(self.need(detector), LENGTH_UNITS, "m"))
        size = self.find("instrument/detector/x_pixel_size")
        if pixel is None and size is not None:
            pixel = float(self.numbers(size).reshape(-1)[0]) * self.unit(size, LENGTH_UNITS, "m")
        return magnified(label, before, behind, pixel or 0.0, (0, 0) if pixel is None else self.shape)

    def flips(self) -> tuple[bool, bool]:
        """Whether the stored frames are upside down, and mirrored: by their flags, or by half turns of the detector.

        A half turn about the vertical mirrors, one about the horizontal turns upside down, one about the beam does
        both; the vertical is z, and the beam x, unless the file has McStas' axes. Errors: `InputError` for other turns.
        """
        flags = [bool(self.numbers(name).any()) if self.find(name) else False for name in FLIPS]
        turns = np.zeros(3, dtype=bool)
        for item in self._transformations():
            if attribute_text(item.attrs.get("transformation_type")) != "rotation":
                continue
            label, unit = f"{self.path}: {item.name}", attribute_text(item.attrs.get("units")) or "deg"
            angle = np.rad2deg(np.asarray(item, dtype=np.float64).reshape(-1) * unit_factor(label, unit, ANGLE_UNITS))
            axis = np.abs(np.asarray(item.attrs.get("vector", np.zeros(3)), dtype=np.float64).reshape(-1)) > 0.5
            half = np.isclose(angle % 360, 180)
            known = bool(np.isclose(angle % 180, 0).all() and (half.all() or not half.any())) and axis.sum() == 1
            require(
                known and len(axis) == 3,
                f"{label} turns the detector by {angle[0]:.4g} degrees, but only half turns about its axes are read; "
                "turn the frames upright, and take it out.",
            )
            turns ^= axis & bool(half.all())
        mcstas = (attribute_text(self.group.attrs.get(COORDINATES)) or "").lower() == "mcstas"
        across, up, along = turns if mcstas else turns[[1, 2, 0]]
        return bool(flags[0] ^ across ^ along), bool(flags[1] ^ up ^ along)

    def _transformations(self) -> Iterator[h5py.Dataset]:
        """The detector's transformations: the chain of its `depends_on`, or all of its group `transformations`."""
        detector, group = self.group.get("instrument/detector"), self.group.get(TRANSFORMATIONS)
        start = detector.get("depends_on") if isinstance(detector, h5py.Group) else None
        if not isinstance(start, h5py.Dataset) or start.shape != ():
            items = group.values() if isinstance(group, h5py.Group) else ()
            yield from (item for item in items if isinstance(item, h5py.Dataset))
            return
        parent, text, seen = detector, attribute_text(start[()]), set[str]()
        while isinstance(parent, h5py.Group) and text and text != ".":
            item = parent.get(text)
            if not isinstance(item, h5py.Dataset) or item.name in seen:
                raise InputError(
                    f"{self.path}: {parent.name} depends on {text}, which is no transformation; correct it."
                )
            seen.add(str(item.name))
            yield item
            parent, text = item.parent, attribute_text(item.attrs.get("depends_on"))

    def about_axis(self, views: Views) -> Views:
        """The views about the axis that the file says, if it does. Errors: `InputError` for one beyond the frames."""
        name, view = self.find(*AXIS), self.group.get(VIEW)
        field = attribute_text(view[()]) if isinstance(view, h5py.Dataset) and view.shape == () else None
        if name is None and (field or "").lower() == "half":
            warn(f"{self.label(VIEW)} says Half, but no axis is said; find it by holosplat align --axis-only")
        if name is None or not np.isfinite(values := self.numbers(name)).all() or not values.any():
            return views
        require(
            values.size == 1 or bool(np.ptp(values) == 0),
            f"{self.label(name)} must be one number, but it differs from frame to frame; write one, or {SHIFT} of "
            "each.",
        )
        width, units = views.shape[1], {**LENGTH_UNITS, **dict.fromkeys(PIXELS, views.pixel_size)}
        value = float(values.reshape(-1)[0]) * self.unit(name, units, "px") / views.pixel_size
        column = 0.5 * (width - 1) + value * (-1 if self.flips()[1] else 1)
        require(
            -0.5 <= column <= width - 0.5,
            f"{self.label(name)} must count columns from the middle of {width}, within {width / 2:g} of it, but it is "
            f"{value:g}; correct it, or take it out and say where the axis is by --axis-column.",
        )
        note(f"{self.label(name)}: the axis is at column {column:g} of {width}; --axis-column says otherwise")
        return views.about_column(column)

    def tell_moves(self, pixel: float) -> None:
        """Warn of a sample that moves by half a pixel [m] or more between the projections, which is not read."""
        for name in filter(self.find, MOVES):
            moved = float(np.ptp(self.per_frame(name, LENGTH_UNITS, "m")))
            if moved >= 0.5 * pixel:
                warn(
                    f"{self.label(name)} moves the sample by {format_length(moved)} between the projections, which is "
                    "not read; shift the frames accordingly first"
                )
