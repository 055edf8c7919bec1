"""Volumes as NRRD (teem.sourceforge.net/nrrd/format.html), for 3D Slicer, ITK and ImageJ: δ and β in a file each, µm.

`NAME.nrrd` holds δ and `NAME.beta.nrrd` β: many programs show no file of two arrays. Written raw; read raw and gzip.
"""

from __future__ import annotations

import math
import re
import zlib
from pathlib import Path

import numpy as np

from ..checks import InputError, as_written, require
from ..geometry import Grid
from ..progress import Advance
from ..units import LENGTH_UNITS, unit_factor
from ..version import __version__
from ..volume import Object
from .guard import require_declared, require_memory
from .plain_values import LENGTH_UNIT, micrometres, read_both, values_at, write_both
from .volumes import REFRACTION, Contents, Stored, contents_of, grid_of

TYPES = {"float": "f4", "double": "f8"}
ORDERS = {"little": "<", "big": ">"}
LONGEST = 1 << 16
"""Bytes of a header, at most."""
FIELD = re.compile(r"([^:#]+): (.*)")
"""A field of a header; comments begin with #, keys of other programs stand before :=."""


def write_nrrd(
    path: Path, obj: Object, grid: Grid, on_progress: Advance = lambda fraction: None, of: Contents = REFRACTION
) -> None:
    """Write δ and β of `obj` on `grid` into two files, slab by slab."""
    size, origin = micrometres(grid)
    steps = [[size[axis] if axis == k else 0.0 for k in range(3)] for axis in range(3)]
    lines = (
        "NRRD0004",
        f"# holosplat {__version__}",
        "type: float",
        "dimension: 3",
        "space dimension: 3",
        "sizes: " + " ".join(map(str, reversed(grid.shape))),
        "space directions: " + " ".join(map(_vector, steps)),
        "kinds: domain domain domain",
        'labels: "x" "y" "z"',
        "space units: " + " ".join([f'"{LENGTH_UNIT}"'] * 3),
        f"space origin: {_vector(origin)}",
        "endian: little",
        "encoding: raw",
    )
    head = "\n".join((*lines, "content: "))
    write_both(path, lambda name, _: f"{head}{name}\n\n".encode("ascii"), obj, grid, on_progress, of)


def _vector(numbers: list[float]) -> str:
    return f"({','.join(map(repr, numbers))})"


def read_nrrd(path: Path) -> Stored:
    """The volume of NAME.nrrd and NAME.beta.nrrd, of numbers float or double, raw or gzip, axes that are not turned.

    `InputError` for other NRRD files, and for values in a further file.
    """
    return read_both(path, _read_one)


def _read_one(path: Path) -> tuple[np.ndarray, Grid, Contents]:
    with path.open("rb") as file:
        head, found, _ = file.read(LONGEST).partition(b"\n\n")
    require(
        head.startswith(b"NRRD000") and bool(found), f"{path} must be an NRRD file with its header, but it is none."
    )
    lines = head.decode("latin-1").split("\n")
    fields = {match[1]: match[2] for line in lines if (match := FIELD.fullmatch(line))}
    of = contents_of(fields.get("content", ""))
    for name in ("data file", "datafile", "line skip", "byte skip"):
        require(name not in fields, f"{path} must hold its values itself, but its header has {name!r}; save it whole.")
    with as_written(path, "an NRRD file of three axes, with sizes, space directions, units and origin"):
        kind, order = TYPES[fields["type"]], ORDERS[fields["endian"]]
        shape = tuple(int(number) for number in reversed(fields["sizes"].split()))
        units = re.findall(r'"([^"]*)"', fields["space units"])
        x, y, z = (unit_factor(f"{path}: space units", unit, LENGTH_UNITS) for unit in units)
        steps = np.array(_numbers(fields["space directions"])).reshape(3, 3)
        origin = np.array(_numbers(fields["space origin"])) * (x, y, z)
        require(
            len(shape) == 3 and min(shape) > 0 and np.count_nonzero(steps - np.diag(np.diag(steps))) == 0,
            f"{path} must have three axes that are not turned, but its sizes are {fields['sizes']} and its space "
            f"directions {fields['space directions']}.",
        )
        grid = grid_of(path, shape, (np.diag(steps) * (x, y, z)).tolist(), origin.tolist())
        encoding = fields["encoding"]
    begin = len(head) + 2
    if encoding == "raw":
        return values_at(path, begin, shape, order + kind), grid, of
    require(
        encoding in ("gzip", "gz"), f"{path} must be encoded as raw or gzip, but it is as {encoding!r}; save it so."
    )
    return _unpacked(path, begin, np.dtype(order + kind), shape), grid, of


def _numbers(text: str) -> list[float]:
    return [float(number) for number in re.findall(r"[^\s,()]+", text)]


def _unpacked(path: Path, begin: int, dtype: np.dtype, shape: tuple[int, ...]) -> np.ndarray:
    """Values that are packed by gzip, of which no more are unpacked than the header declares."""
    wanted = dtype.itemsize * math.prod(shape)
    packed = path.read_bytes()[begin:]
    require_declared(str(path), wanted, len(packed))
    require_memory(str(path), wanted)
    try:
        content = zlib.decompressobj(wbits=31).decompress(packed, wanted + 1)
    except zlib.error as error:
        raise InputError(f"{path} must be a complete NRRD file, but its values are damaged: {error}.") from None
    require(
        len(content) == wanted,
        f"{path} must unpack to the {wanted} bytes that its header declares, but it holds other values; save it anew.",
    )
    return np.frombuffer(content, dtype).reshape(shape)
