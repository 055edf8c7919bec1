"""How each frame was taken, as JSON: the part that the folders (TIFF, NeRF-synthetic, R²-Gaussian) have in common."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..checks import InputError, require
from ..geometry import Views, rotation_y
from ..scan import Exposures, Scan
from .table import Table


def beam_table(scan: Scan) -> dict[str, Any]:
    """The values that all frames share: the texts of `provenance`, and `pixel_size_m` and `energy_kev` if they are the
    same."""
    views, exposures = scan.views, scan.exposures
    energy = {"energy_kev": float(exposures.energy_kev[0])} if exposures.has_one_energy else {}
    pixel = {"pixel_size_m": views.pixel_size} if views.has_one_pixel else {}
    return {**pixel, **energy, "provenance": dict(scan.provenance)}


def exposure_table(exposures: Exposures, n: int) -> dict[str, Any]:
    """Frame `n`: `rotation` [3, 3], `shift_m` [2], `distance_m`, `psf_sigma_px`, `time_s`; floats are kept exactly.

    `energy_kev` and `pixel_size_m` too, where frames have several.
    """
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
    }


def read_exposures(beam: Table, frames: Sequence[Table], shape: tuple[int, int]) -> Exposures:
    """Exposures of frames of `shape` (H, W) from what `beam_table` and `exposure_table` wrote.

    Written by hand, a frame may have `angle_deg` instead of `rotation`; `energy_kev`, `distance_m`, `pixel_size_m` and
    `psf_sigma_px` may stand in the beam's table, for all frames; shift, blur and time are 0 where they are left out.
    """
    values = [[_per_frame(beam, f, name, default) for f in frames] for name, default in _NUMBERS]
    shifts = [f.numbers("shift_m", (2,)) if "shift_m" in f else np.zeros(2) for f in frames]
    rotations = [_rotation(f) for f in frames]
    pixel_sizes = np.array([_per_frame(beam, f, "pixel_size_m", None) for f in frames])
    try:
        views = Views.of_pixels(np.array(rotations), np.array(shifts), shape, pixel_sizes)
        energy, distance, psf_sigma, time = (np.array(v) for v in values)
        return Exposures(views, energy, distance, psf_sigma, time)
    except InputError as error:
        raise InputError(f"{beam.path}: {error}") from None


def in_order(head: Table, entries: Sequence[Table]) -> np.ndarray:
    """[N] int: the entry of each frame of the scan, by their `index`: 0 … `count` - 1, each once."""
    found = np.array([entry.number("index") for entry in entries])
    count = head.count("count")
    good = np.array_equal(np.sort(found), np.arange(count))
    where = entries[0].label("index")
    require(good, f"{where} and the others must be 0 to {count - 1}, each once, but they are {found.tolist()}.")
    return np.argsort(found)


_NUMBERS = (("energy_kev", None), ("distance_m", None), ("psf_sigma_px", 0.0), ("time_s", 0.0))
"""Numbers of a frame, in the order of `Exposures`, with their values if they are left out."""


def _per_frame(beam: Table, frame: Table, name: str, default: float | None) -> float:
    if name in frame:
        return frame.number(name)
    if name in beam:
        return beam.number(name)
    return frame.number(name) if default is None else default


def _rotation(frame: Table) -> np.ndarray:
    if "angle_deg" in frame and "rotation" not in frame:
        return rotation_y([frame.number("angle_deg")])[0]
    return frame.numbers("rotation", (3, 3))
