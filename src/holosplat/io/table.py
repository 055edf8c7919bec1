"""JSON tables with clear messages, and the exposures that they hold, for the readers of folders."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..checks import InputError, finite, require, shaped
from ..geometry import Views, rotation_y
from ..scan import Exposures, Scan
from ..tables import shown
from .atomic import read_json


@dataclass(frozen=True)
class Table:
    """The entries `values` of the JSON file `path`, below `where` in it; messages name the file and the entry."""

    path: Path
    values: dict[str, Any]
    where: str = ""

    @classmethod
    def read(cls, path: Path) -> Table:
        """The table that a file holds."""
        require(path.is_file(), f"{path} must be a JSON file, but there is no such file; check the folder.")
        return cls(path, read_json(path))

    def __contains__(self, name: str) -> bool:
        return name in self.values

    def label(self, name: str) -> str:
        """How messages call the entry `name`."""
        return f"{self.path}: {self.where}{name}"

    def need(self, name: str) -> Any:
        """The entry `name`; `InputError` where there is none."""
        if name not in self.values:
            raise InputError(f"{self.label(name)} must be there, but it is missing; add it.")
        return self.values[name]

    def number(self, name: str) -> float:
        """A finite number."""
        return float(self.numbers(name, ()))

    def numbers(self, name: str, shape: tuple[int, ...]) -> np.ndarray:
        """Finite numbers, float64, nested as `shape` says."""
        value = self.need(name)
        try:
            array = np.array(value)
        except ValueError:  # rows of unequal length
            array = np.array("uneven rows")
        if array.dtype.kind not in "iuf":
            raise InputError(f"{self.label(name)} must hold numbers, but it is {shown(value)}.")
        return finite(self.label(name), shaped(self.label(name), array.astype(np.float64), shape))

    def counts(self, name: str, shape: tuple[int, ...]) -> tuple[int, ...]:
        """Whole numbers, none of them negative."""
        numbers = self.numbers(name, shape).reshape(-1)
        whole = bool((numbers == np.floor(numbers)).all() and (numbers >= 0).all())
        require(whole, f"{self.label(name)} must hold whole numbers from 0 on, but it is {shown(self.values[name])}.")
        return tuple(int(n) for n in numbers)

    def text(self, name: str) -> str:
        """A text."""
        value = self.need(name)
        require(isinstance(value, str), f"{self.label(name)} must be a text, but it is {shown(value)}.")
        return value

    def require_format(self, known: str) -> None:
        """`InputError` unless the entry `format` is the one that is `known`."""
        found = self.text("format")
        require(found == known, f"{self.label('format')} must be {known!r}, but it is {found!r}; write it anew.")

    def flag(self, name: str) -> bool:
        """True or false."""
        value = self.need(name)
        require(isinstance(value, bool), f"{self.label(name)} must be true or false, but it is {shown(value)}.")
        return value

    def table(self, name: str) -> Table:
        """A table within the table."""
        value = self.need(name)
        require(isinstance(value, dict), f"{self.label(name)} must be a table, but it is {shown(value)}.")
        return Table(self.path, value, f"{self.where}{name}.")

    def tables(self, name: str) -> list[Table]:
        """A list of tables."""
        value = self.need(name)
        good = isinstance(value, list) and all(isinstance(entry, dict) for entry in value)
        require(good, f"{self.label(name)} must be a list of tables, but it is {shown(value)}.")
        return [Table(self.path, entry, f"{self.where}{name}[{n}].") for n, entry in enumerate(value)]

    def texts(self, name: str) -> dict[str, str]:
        """A table of texts; empty where there is none."""
        found = self.table(name) if name in self else Table(self.path, {})
        return {key: found.text(key) for key in found.values}

    def file(self, name: str, suffix: str = "") -> Path:
        """A file below the folder of this one, whose path (before `suffix`) is the entry `name`."""
        folder = self.path.parent.resolve()
        nameable = "\0" not in self.text(name)
        require(nameable, f"{self.label(name)} must be the name of a file, but it is {shown(self.values[name])}.")
        found = (folder / (self.text(name) + suffix)).resolve()
        inside = found.is_relative_to(folder)
        require(inside, f"{self.label(name)} must name a file in the folder, but it is {shown(self.values[name])}.")
        require(found.is_file(), f"{self.label(name)} names {self.text(name) + suffix}, but there is no such file.")
        return found


def beam_table(scan: Scan) -> dict[str, Any]:
    """The values that all frames share: `provenance`, and `pixel_size_m` and `energy_kev` if they are the same."""
    views, exposures = scan.views, scan.exposures
    energy = {"energy_kev": float(exposures.energy_kev[0])} if exposures.has_one_energy else {}
    pixel = {"pixel_size_m": views.pixel_size} if views.has_one_pixel else {}
    return {**pixel, **energy, "provenance": dict(scan.provenance)}


def exposure_table(exposures: Exposures, n: int) -> dict[str, Any]:
    """Frame `n`: `rotation` [3, 3], `shift_m` [2], `distance_m`, `psf_sigma_px`, `time_s`, exactly; `energy_kev` and
    `pixel_size_m` where frames have several, `bandwidth` where any has one, and `source_m` of cones of rays."""
    views = exposures.views
    energy = {} if exposures.has_one_energy else {"energy_kev": float(exposures.energy_kev[n])}
    pixel = {} if views.has_one_pixel else {"pixel_size_m": float(views.pixel_sizes[n])}
    return {
        **pixel,
        **energy,
        "rotation": exposures.views.rotations[n].tolist(),
        "shift_m": exposures.views.shifts[n].tolist(),
        "distance_m": float(exposures.distance[n]),
        "psf_sigma_px": float(exposures.psf_sigma_px[n]),
        "time_s": float(exposures.time[n]),
        **({} if views.sources is None else {"source_m": float(views.sources[n])}),
        **({"bandwidth": float(exposures.bandwidth[n])} if np.any(exposures.bandwidth) else {}),
    }


def read_exposures(beam: Table, frames: Sequence[Table], shape: tuple[int, int]) -> Exposures:
    """Exposures of frames of `shape` (H, W) from what `beam_table` and `exposure_table` wrote.

    Written by hand, a frame may have `angle_deg` instead of `rotation`; `energy_kev`, `distance_m`, `pixel_size_m`,
    `psf_sigma_px` and `source_m` may stand in the beam's table, for all frames; shift, blur and time are 0 where left
    out.
    """
    values = [[_per_frame(beam, f, name, default) for f in frames] for name, default in _NUMBERS]
    shifts = [f.numbers("shift_m", (2,)) if "shift_m" in f else np.zeros(2) for f in frames]
    rotations = [
        rotation_y([f.number("angle_deg")])[0]
        if "angle_deg" in f and "rotation" not in f
        else f.numbers("rotation", (3, 3))
        for f in frames
    ]
    pixel_sizes = np.array([_per_frame(beam, f, "pixel_size_m", None) for f in frames])
    try:
        views = Views.of_pixels(np.array(rotations), np.array(shifts), shape, pixel_sizes)
        if "source_m" in beam or any("source_m" in f for f in frames):
            views = replace(views, sources=np.array([_per_frame(beam, f, "source_m", None) for f in frames]))
        energy, distance, psf_sigma, time, bandwidth = (np.array(v) for v in values)
        return Exposures(views, energy, distance, psf_sigma, time, bandwidth=bandwidth)
    except InputError as error:
        raise InputError(f"{beam.path}: {error}") from None


def read_own_exposures(head: Table, frames: Sequence[Table], shape: tuple[int, int]) -> tuple[np.ndarray, Exposures]:
    """The number [N] of each frame of the scan among `frames` of our own, by their `index`, and the exposures."""
    entries = [frame.table("holosplat") for frame in frames]
    found, count = np.array([entry.number("index") for entry in entries]), head.counts("count", ())[0]
    good = np.array_equal(np.sort(found), np.arange(count))
    where = entries[0].label("index")
    require(good, f"{where} and the others must be 0 to {count - 1}, each once, but they are {found.tolist()}.")
    order = np.argsort(found)
    return order, read_exposures(head, [entries[k] for k in order], shape)


_NUMBERS = (("energy_kev", None), ("distance_m", None), ("psf_sigma_px", 0.0), ("time_s", 0.0), ("bandwidth", 0.0))
"""Numbers of a frame, in the order of `Exposures`, with their values if they are left out."""


def _per_frame(beam: Table, frame: Table, name: str, default: float | None) -> float:
    if name in frame:
        return frame.number(name)
    if name in beam:
        return beam.number(name)
    return frame.number(name) if default is None else default
