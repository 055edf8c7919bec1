"""Volumes as MRC2014 (Cheng et al. 2015, doi:10.1016/j.jsb.2015.04.002), for ChimeraX, IMOD and others: lengths in Å.

A file holds one array: `NAME.mrc` δ, and `NAME.beta.mrc` β.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..checks import require
from ..geometry import Grid
from ..progress import Advance
from ..version import __version__
from ..volume import Object
from .plain_values import read_both, values_at, write_both
from .volumes import REFRACTION, Contents, Stored, contents_of, grid_of

ANGSTROM = 1e-10
FLOATS, VOLUME, VERSION = 2, 1, 20140
"""Numbers by which MRC2014 names values of float32, a single volume, and itself."""
HEADER = np.dtype(
    [
        ("n", "<i4", 3),
        ("mode", "<i4"),
        ("start", "<i4", 3),
        ("m", "<i4", 3),
        ("cell", "<f4", 3),
        ("angles", "<f4", 3),
        ("axes", "<i4", 3),
        ("limits", "<f4", 3),
        ("space_group", "<i4"),
        ("extended", "<i4"),
        ("extra", "S8"),
        ("kind", "S4"),
        ("version", "<i4"),
        ("more", "S84"),
        ("origin", "<f4", 3),
        ("map", "S4"),
        ("stamp", "S4"),
        ("deviation", "<f4"),
        ("label_count", "<i4"),
        ("labels", "S80", 10),
    ]
)
"""Least and greatest value and mean are `limits`; x, y, z stand in this order, which `axes` says."""
STAMPS = {b"DD": "<", b"DA": "<", b"\x11\x11": ">"}
"""Byte order by the first two bytes of the stamp."""


def write_mrc(
    path: Path, obj: Object, grid: Grid, on_progress: Advance = lambda fraction: None, of: Contents = REFRACTION
) -> None:
    """Write δ and β of `obj` on `grid` into two files, slab by slab."""

    def head(name: str, statistics: np.ndarray) -> bytes:
        found = np.zeros((), HEADER)
        found["n"] = found["m"] = grid.shape[::-1]
        found["cell"] = np.array(grid.voxel_size) * grid.shape[::-1] / ANGSTROM
        found["origin"] = np.array(grid.origin) / ANGSTROM
        found["mode"], found["space_group"], found["version"], found["label_count"] = FLOATS, VOLUME, VERSION, 1
        found["angles"], found["axes"], found["map"], found["stamp"] = 90, (1, 2, 3), b"MAP ", b"DD"
        found["limits"], found["deviation"] = statistics[:3], statistics[3]
        found["labels"][0] = f"holosplat {__version__}: {name}, unit {of.units[name]}".encode("ascii")
        return found.tobytes()

    write_both(path, head, obj, grid, on_progress, of)


def read_mrc(path: Path) -> Stored:
    """The volume of NAME.mrc and NAME.beta.mrc, single volumes of float32.

    `InputError` for other MRC files. Lengths come back to seven digits, which the header has of them.
    """
    return read_both(path, _read_one)


def _read_one(path: Path) -> tuple[np.ndarray, Grid, Contents]:
    with path.open("rb") as file:
        raw = file.read(HEADER.itemsize).ljust(HEADER.itemsize, b"\0")
    head = np.frombuffer(raw, HEADER)[0]
    order = STAMPS.get(bytes(head["stamp"])[:2])
    require(
        bytes(head["map"]).rstrip() == b"MAP" and order is not None,
        f"{path} must be an MRC2014 file, but its header is not that of one.",
    )
    of = contents_of(bytes(head["labels"][0]).decode("latin-1"))
    head = np.frombuffer(raw, HEADER.newbyteorder("<" if order == "<" else ">"))[0]
    columns, rows, pages = (int(n) for n in head["n"])
    fits = int(head["mode"]) == FLOATS and head["axes"].tolist() == [1, 2, 3] and (head["n"] == head["m"]).all()
    require(
        bool(fits) and min(columns, rows, pages) > 0 and int(head["extended"]) >= 0,
        f"{path} must be one volume of float32 (mode {FLOATS}) with axes x, y, z, but it is of {columns} × {rows} × "
        f"{pages} values of mode {int(head['mode'])} with axes {head['axes'].tolist()}.",
    )
    shape = pages, rows, columns
    size = ANGSTROM * head["cell"].astype(float) / head["n"]
    grid = grid_of(path, shape, size.tolist(), (ANGSTROM * head["origin"].astype(float)).tolist())
    return values_at(path, HEADER.itemsize + int(head["extended"]), shape, f"{order}f4"), grid, of
