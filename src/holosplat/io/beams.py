"""`geometry.toml`: where beams look from, in a file that people read and write, for any scan of these beams."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..checks import InputError, require, shaped
from ..geometry import Views, rotation_tilted
from ..ranges import Metres, Signed, Small, checked_dataclass
from ..scan import Exposures, Scan
from ..tables import from_table, read_table
from .atomic import atomic_path

FORMAT = "holosplat geometry 1"
MOST_VIEWS = 50_000
"""Views of a file, at most: more take a minute to read, and no scan has them."""
ERRORS = ("shift_px", "turn_deg", "distance_share", "magnification_share")

Pair = tuple[Signed, Signed]
Triple = tuple[Signed, Signed, Signed]


@checked_dataclass
class ViewErrors:
    """Standard errors of what was found of a view."""

    shift_px: Pair = (0.0, 0.0)
    """Shifts along rows and columns [pixels]."""
    turn_deg: Triple = (0.0, 0.0, 0.0)
    """Turns about x and y, across the beam, and z, the roll [degrees]."""
    distance_share: float = 0.0
    """Distance, as a share of it."""
    magnification_share: float = 0.0
    """Magnification, as a share of it."""


@checked_dataclass
class BeamView:
    """One view of the file, an entry `[[view]]`; what is left out stays as the scan says."""

    rotation: tuple[Triple, Triple, Triple] | None = None
    """Rows of R, `x_lab = R x_obj`."""
    angle_deg: Signed | None = None
    """Or: the angle about y [degrees]."""
    tilt_deg: Signed | None = None
    """With it: how far the beam leaves the plane normal to y [degrees]."""
    shift_m: Pair | None = None
    """Detector's shift (sx, sy) [m]."""
    shift_px: Pair | None = None
    """Or: the shift [pixels]."""
    distance_m: Metres | None = None
    """Effective propagation distance [m]."""
    energy_kev: float | None = None
    """Photon energy [keV]."""
    pixel_size_m: Small | None = None
    """Effective pixel size [m]."""
    error: ViewErrors | None = None
    """Standard errors, which are kept and not used."""

    def __post_init__(self) -> None:
        given = (self.rotation is not None) + (self.angle_deg is not None)
        require(given == 1, "a view must have either rotation or angle_deg; give one of the two.")
        require(self.tilt_deg is None or self.angle_deg is not None, "tilt_deg goes with angle_deg; give both.")
        require(self.shift_m is None or self.shift_px is None, "a view has shift_m or shift_px; leave one of the two.")

    def matrix(self) -> np.ndarray:
        """R [3, 3]."""
        if self.angle_deg is not None:
            return rotation_tilted([self.angle_deg], [self.tilt_deg or 0.0])[0]
        return np.array(self.rotation)


@dataclass(frozen=True)
class _File:
    """What the file holds beside `made_by`."""

    format: str
    view: tuple[BeamView, ...] = ()


@dataclass(frozen=True)
class Beams:
    """The geometry of V beams; made_by: texts on its origin, by name."""

    view: tuple[BeamView, ...]
    format: str = FORMAT
    made_by: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        require(self.format == FORMAT, f"format must be {FORMAT!r}, but it is {self.format!r}; correct it.")
        require(len(self.view) > 0, "there must be a table [[view]] for each beam, but there is none.")
        Views.from_rotations(np.array([each.matrix() for each in self.view]), (1, 1), 1.0)

    def __len__(self) -> int:
        return len(self.view)

    @classmethod
    def of(
        cls, exposures: Exposures, errors: np.ndarray | None = None, made_by: Mapping[str, str] | None = None
    ) -> Beams:
        """Those of `exposures` [V]; errors: [V, 7] standard errors of shifts x, y [pixels], turns about x, y, z
        [degrees], and of distance and magnification as shares of them."""
        known = None if errors is None else shaped("errors", np.asarray(errors), (len(exposures), 7)).tolist()
        views = []
        for v in range(len(exposures)):
            rows = exposures.views.rotations[v].tolist()
            shift, told = exposures.views.shifts[v].tolist(), None
            if known is not None:
                x, y, *turns, distance, larger = known[v]
                told = ViewErrors((x, y), _triple(turns), distance, larger)
            rotation = (_triple(rows[0]), _triple(rows[1]), _triple(rows[2]))
            distance, energy = float(exposures.distance[v]), float(exposures.energy_kev[v])
            pixel = None if exposures.views.has_one_pixel else float(exposures.views.pixel_sizes[v])
            rest = {"distance_m": distance, "energy_kev": energy, "pixel_size_m": pixel}
            views.append(BeamView(rotation, shift_m=(shift[0], shift[1]), **rest, error=told))
        return cls(tuple(views), made_by=dict(made_by or {}))

    def with_pixel_size(self, pixel_size: float) -> Beams:
        """The same with a pixel size [m] that scans then take from here."""
        return replace(self, view=tuple(replace(each, pixel_size_m=pixel_size) for each in self.view))

    def said(self, name: str) -> np.ndarray | None:
        """The numbers `name` [V] if all views have them; None if none has. Errors: `InputError` where some have."""
        values = [getattr(each, name) for each in self.view]
        first = next((v for v, value in enumerate(values) if value is not None), None)
        if first is None:
            return None
        lacking = next((v for v, value in enumerate(values) if value is None), None)
        require(lacking is None, f"view[{lacking}].{name} is missing, which view[{first}] has; add it, or leave all.")
        return np.array(values, dtype=np.float64)

    def scalars(self) -> dict[str, float]:
        """What is said in place of --energy-kev, --distance and --pixel-size: the first view's, by name."""
        names = {"energy_kev": "energy_kev", "distance": "distance_m", "pixel_size": "pixel_size_m"}
        found = {name: self.said(field) for name, field in names.items()}
        return {name: float(values[0]) for name, values in found.items() if values is not None}

    def applied(self, scan: Scan) -> Scan:
        """The same frames in these exposures; errors: those of `on`."""
        return scan.taken(self.on(scan.exposures))

    def on(self, planned: Exposures) -> Exposures:
        """These exposures in place of those `planned`, one a frame, or a frame of every time; `InputError` for another
        number."""
        index, times = np.arange(len(self)), planned.time
        if len(times) != len(self):
            index = np.zeros(len(times), dtype=int)
            for time in np.unique(times):
                at = np.flatnonzero(times == time)
                require(
                    len(at) == len(self),
                    f"the geometry must have a view for each of the {len(times)} frames, or for each of the {len(at)} "
                    f"of every time, but it has {len(self)}; take that of this scan.",
                )
                index[at] = np.arange(len(self))
        pixels, metres, in_pixels = (self.said(name) for name in ("pixel_size_m", "shift_m", "shift_px"))
        sizes = planned.views.pixel_sizes if pixels is None else pixels[index]
        rotations = np.array([each.matrix() for each in self.view])[index]
        shifts = planned.views.shifts if metres is None else metres[index]
        shifts = shifts if in_pixels is None else sizes[:, None] * in_pixels[index]
        views = replace(planned.views, rotations=rotations, shifts=shifts)
        if pixels is not None:
            views = replace(Views.of_pixels(rotations, shifts, views.shape, sizes), sources=views.sources)
        distance, energy = self.said("distance_m"), self.said("energy_kev")
        return replace(
            planned,
            views=views,
            distance=planned.distance if distance is None else distance[index],
            energy_kev=planned.energy_kev if energy is None else energy[index],
        )

    def text(self) -> str:
        """The file's content."""
        lines = ["# Where beams look from (docs/geometry_files.md); lengths in metres.", f'format = "{FORMAT}"']
        if self.made_by:
            lines += ["", "[made_by]", *(f"{name} = {_quoted(text)}" for name, text in self.made_by.items())]
        for v, each in enumerate(self.view):
            lines += ["", f"[[view]]  # {v}"]
            for name, value in vars(each).items():
                if value is None:
                    continue
                if isinstance(value, ViewErrors):
                    inner = ", ".join(f"{key} = {_number(getattr(value, key), '.3g')}" for key in ERRORS)
                    lines.append(f"error = {{ {inner} }}")
                else:
                    lines.append(f"{name} = {_number(value)}")
        return "\n".join(lines) + "\n"


def read_beams(path: str | Path) -> Beams:
    """The geometry in the file at `path`. Errors: `InputError` that names the file and what is amiss in it."""
    table = read_table(Path(path))
    origin = table.pop("made_by", {})
    texts = isinstance(origin, dict) and all(isinstance(text, str) for text in origin.values())
    require(texts, f"{path}: made_by must be a table of texts, but it is {origin!r}.")
    views = table.get("view")
    count = len(views) if isinstance(views, list) else 0
    require(count <= MOST_VIEWS, f"{path} must have at most {MOST_VIEWS} views, but it has {count}; take fewer.")
    require("format" in table, f"{path}: format is missing; a file of a geometry begins with format = {FORMAT!r}.")
    try:
        found = from_table(_File, table)
        beams = Beams(found.view, found.format, origin)
        for name in ("shift_m", "shift_px", "distance_m", "energy_kev", "pixel_size_m"):
            beams.said(name)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    return beams


def write_beams(path: str | Path, beams: Beams) -> None:
    """Write a geometry as TOML; floats are kept exactly."""
    with atomic_path(path) as temporary:
        temporary.write_text(beams.text(), encoding="utf-8")


def _triple(row: list[float]) -> Triple:
    return row[0], row[1], row[2]


def _quoted(text: str) -> str:
    escaped = text.replace("\\", "\\\\").replace('"', '\\"')
    return '"' + "".join(c if c.isprintable() else " " for c in escaped) + '"'


def _number(value: Any, form: str | None = None) -> str:
    """A number, or nested tuples of them, as TOML has them."""
    if isinstance(value, tuple | list):
        return "[" + ", ".join(_number(each, form) for each in value) + "]"
    number = float(value)
    text = repr(number) if form is None else format(number, form)
    return text if any(c in text for c in ".en") else f"{text}.0"
