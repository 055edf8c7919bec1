"""The content of the view in three dimensions, and its text in the page."""

from __future__ import annotations

import base64
import json
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any

import matplotlib as mpl
import numpy as np
from markupsafe import Markup

from ...geometry import Views
from ...scan import Exposures
from ...units import wavenumber
from .parts import ViewPart

MOST_COLUMNS = 320
"""Raster pixels along the longer edge of the view's frame."""
FINE_COLUMNS = 160
"""Detector pixels along it up to which the raster is twice as fine, for the waves' sake."""
MOST_VIEWS = 64
"""Views of the scan that can be chosen."""


@dataclass(frozen=True)
class View3D:
    """What the view shows: objects by name, slices by the same names, and how frames are taken of them.

    parts: the first is shown at first; slices: volumes of some of the parts; exposures: of the frame that the view
    imitates (one); views: of the scan, which can be chosen; labels: theirs; grey: limits of the frames' grey scale;
    delta_told: whether δ is known, and with it the phase; else absorption is shown; top: the phase shift [rad], or the
    absorption, at which colours end; picture: the first view as a `data:` URI, where WebGL is missing.
    """

    parts: Mapping[str, ViewPart]
    slices: Mapping[str, ViewPart]
    exposures: Exposures
    views: Views
    labels: tuple[str, ...]
    grey: tuple[float, float]
    top: float
    picture: str = ""
    delta_told: bool = True


def raster_of(rows: int, columns: int, pixel: float) -> tuple[int, int, float]:
    """Rows, columns and pixel [m] of the raster of the view of a detector of `rows` × `columns` of `pixel` [m].

    Twice as fine as a small detector; coarser than a large one, whose fringes it then does not show.
    """
    longest = max(rows, columns)
    factor = 0.5 if longest <= FINE_COLUMNS else max(1, -(-longest // MOST_COLUMNS))
    return round(rows / factor), round(columns / factor), pixel * factor


def html(view: View3D) -> Markup:
    """The view as a part of the page: its elements, data and script; nothing is loaded from elsewhere."""
    header, blob = packed(view)
    data = base64.b64encode(zlib.compress(blob, 9)).decode()
    # In a script element "<" could end it; JSON may write it as an escape.
    text = json.dumps(header, separators=(",", ":")).replace("<", "\\u003c")
    return Markup(_source("view.html")).format(
        picture=view.picture, header=Markup(text), data=Markup(data), script=Markup(_source("view.js"))
    )


def packed(view: View3D) -> tuple[dict[str, Any], bytes]:
    """What describes the arrays, and their bytes, each aligned to four."""
    blob = bytearray()

    def described(part: ViewPart) -> dict[str, Any]:
        arrays = {}
        for name, array in part.arrays.items():
            blob.extend(b"\0" * (-len(blob) % 4))
            arrays[name] = {"type": array.dtype.name, "shape": list(array.shape), "at": len(blob)}
            blob.extend(np.ascontiguousarray(array).astype(array.dtype.newbyteorder("<")).tobytes())
        return {"kind": part.kind, "arrays": arrays, "channels": [list(c) for c in part.channels], **part.facts}

    optical = view.exposures.optical
    rows, columns, pixel = raster_of(*view.exposures.views.shape, view.exposures.views.pitch)
    energy = float(view.exposures.energy_kev[0])
    return {
        "rows": rows,
        "columns": columns,
        "pixel": pixel,
        "detector_pixel": view.exposures.views.pitch,
        "k": float(wavenumber(energy)),
        "distance": float(optical.distance[0]),
        "psf": float(optical.psf_sigma_px[0]) * view.exposures.views.pitch / pixel,
        "parts": {name: described(part) for name, part in view.parts.items()},
        "slices": {name: described(part) for name, part in view.slices.items()},
        "rotations": [r.ravel().round(7).tolist() for r in view.views.rotations[:MOST_VIEWS]],
        "shifts": (view.views.shifts[:MOST_VIEWS] / pixel).round(5).tolist(),
        "labels": list(view.labels[:MOST_VIEWS]),
        "grey": list(view.grey),
        "top": view.top,
        "delta_told": view.delta_told,
        "colours": _colours(),
    }, bytes(blob)


@cache
def _colours() -> list[int]:
    """256 colours from dark to light, as red, green and blue in turn."""
    return np.rint(255 * mpl.colormaps["magma"](np.linspace(0, 1, 256))[:, :3]).astype(int).ravel().tolist()


@cache
def _source(name: str) -> str:
    return files(__package__ or "").joinpath(name).read_text(encoding="utf-8")
