"""Point clouds to PLY files (Turk 1994), as programs that fit Gaussians start from them."""

from __future__ import annotations

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
    names = [(name, "float" if POINT[name] == np.dtype("<f4") else "uchar") for name in POINT.names or ()]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    header += [f"property {kind} {name}" for name, kind in names] + ["end_header", ""]
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        file.write("\n".join(header).encode("ascii"))
        file.write(rows.tobytes())
