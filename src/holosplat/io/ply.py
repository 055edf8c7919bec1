"""Point clouds to PLY files (Turk 1994), as programs that fit Gaussians start from them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..checks import finite, shaped
from .atomic import atomic_path

POINT = np.dtype(
    [(name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")] + [(c, "u1") for c in ("red", "green", "blue")]
)
"""A point of the file: position, normal (which these programs ask for, and do not use), colour."""


def write_ply(path: str | Path, points: np.ndarray, grey: int = 128) -> None:
    """Write points [N, 3], in whatever unit, as binary little-endian PLY; all have the colour (grey, grey, grey)."""
    shaped("points", finite("points", np.asarray(points, dtype=np.float64)), (None, 3))
    rows = np.zeros(len(points), POINT)
    for axis, name in enumerate("xyz"):
        rows[name] = points[:, axis]
    for name in ("red", "green", "blue"):
        rows[name] = grey
    write_vertices(path, rows)


def write_vertices(path: str | Path, rows: np.ndarray, comments: Sequence[str] = ()) -> None:
    """Write the vertices `rows` [N], whose fields are little-endian float32 or uint8, with lines of comment."""
    kinds = {np.dtype("<f4"): "float", np.dtype("u1"): "uchar"}
    header = ["ply", "format binary_little_endian 1.0", *(f"comment {line}" for line in comments)]
    header += [f"element vertex {len(rows)}"]
    header += [f"property {kinds[rows.dtype[name]]} {name}" for name in rows.dtype.names or ()]
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        file.write("\n".join([*header, "end_header", ""]).encode("ascii"))
        file.write(rows.tobytes())
