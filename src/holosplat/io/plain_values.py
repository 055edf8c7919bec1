"""δ (or µ) and β as plain float32 numbers, x fastest, as files of VTK, NRRD and MRC hold them: written slab by slab.

NRRD (teem.sourceforge.net/nrrd/format.html) is for 3D Slicer, ITK and ImageJ: lengths in µm, written raw, read raw and
gzip. MRC2014 (Cheng et al. 2015, doi:10.1016/j.jsb.2015.04.002) is for ChimeraX, IMOD and others: lengths in Å. A file
holds one array, as many programs show no more: `NAME.nrrd` δ, and `NAME.beta.nrrd` β.

Volumes of several times in HDF5 as one XDMF file (xdmf.org), for ParaView and VisIt: lengths in µm, times in s.
It holds no values, but names the HDF5 files relative to its folder, so that it can move with them.
"""

from __future__ import annotations

import math
import re
import zlib
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import BinaryIO
from xml.sax.saxutils import escape

import numpy as np

from ..checks import InputError, as_written, finite, require, require_regular
from ..geometry import Grid
from ..progress import Advance
from ..units import LENGTH_UNITS, unit_factor
from ..version import __version__
from ..volume import Object
from .atomic import atomic_path
from .guard import require_declared, require_memory
from .hdf5 import require_room
from .volumes import NAMES, REFRACTION, Contents, Stored, contents_of, grid_of, slab_rows, slabs_of

MICROMETRES = 1e6
LENGTH_UNIT = "um"
"""The unit of lengths in these files, as in those of bodies."""


def fill(
    places: Sequence[tuple[BinaryIO, int]], obj: Object, grid: Grid, on_progress: Advance, of: Contents
) -> np.ndarray:
    """Write δ and β of `obj` on `grid`, or what else is `of` it, at `places`: open files and the bytes where values
    begin. Returns least and greatest values, means and standard deviations [2, 4]."""
    _, y, x = grid.shape
    found = np.array([[np.inf, -np.inf, 0.0, 0.0]] * len(NAMES))
    for start, part in slabs_of(obj, grid, slab_rows(grid), on_progress):
        for (file, begin), array, row in zip(places, of.of_volume(part).values(), found):
            values = array.astype("<f4")
            for z, page in enumerate(values):
                file.seek(begin + 4 * x * (z * y + start))
                file.write(page.tobytes())
            row[:2] = min(row[0], values.min()), max(row[1], values.max())
            row[2:] += values.sum(dtype=np.float64), np.square(values, dtype=np.float64).sum()
    found[:, 2:] /= math.prod(grid.shape)
    found[:, 3] = np.sqrt(np.maximum(0.0, found[:, 3] - found[:, 2] ** 2))
    return found


def values_at(path: Path, begin: int, shape: tuple[int, ...], dtype: str = "<f4") -> np.ndarray:
    """The numbers of `shape` that stand in a file from the byte `begin` on. `InputError` for a file that is shorter."""
    wanted, held = begin + np.dtype(dtype).itemsize * math.prod(shape), path.stat().st_size
    require(
        wanted <= held,
        f"{path} must hold {wanted:.4g} bytes, as its header declares, but it has {held}; it is cut off or damaged.",
    )
    require_memory(str(path), wanted)
    return np.fromfile(path, dtype, math.prod(shape), offset=begin).reshape(shape)


def micrometres(grid: Grid) -> tuple[list[float], list[float]]:
    """The voxels' size and the first voxel's centre (x, y, z) [µm], to 12 digits."""
    size, origin = ([float(f"{MICROMETRES * v:.12g}") for v in of] for of in (grid.voxel_size, grid.origin))
    return size, origin


def both(path: Path) -> tuple[Path, Path]:
    """The files of δ and of β where a file holds one array: NAME.nrrd and NAME.beta.nrrd."""
    return path, path.with_suffix(f".beta{path.suffix}")


def write_both(
    path: Path, head: Callable[[str, np.ndarray], bytes], obj: Object, grid: Grid, on_progress: Advance, of: Contents
) -> None:
    """Write δ and β of `obj` on `grid` into two files (`both`), each behind a `head` of one length, made from the
    array's name and its least and greatest value, mean and standard deviation [4]."""
    unknown = np.zeros(4)
    require_room(path, len(NAMES) * (len(head(next(iter(of.units)), unknown)) + 4 * math.prod(grid.shape)))
    with ExitStack() as stack:
        temporary = [stack.enter_context(atomic_path(one)) for one in both(path)]
        files = [stack.enter_context(one.open("wb")) for one in temporary]
        begins = [file.write(head(name, unknown)) for file, name in zip(files, of.units)]
        for file, name, row in zip(files, of.units, fill(list(zip(files, begins)), obj, grid, on_progress, of)):
            file.seek(0)
            file.write(head(name, row))


def read_both(path: Path, read_one: Callable[[Path], tuple[np.ndarray, Grid, Contents]]) -> Stored:
    """The volume of two files (`both`), each as `read_one` reads it. `InputError` where one is missing or differs."""
    first, beta = both(path)
    require(
        beta.is_file() or not first.is_file(),
        f"{path} holds one array; its β must lie beside it as {beta.name}, but there is no such file.",
    )
    for one in (first, beta):
        require_regular(one, f"a {path.suffix} file")
    (values, grid, of), (others, other, _) = (read_one(one) for one in (first, beta))
    require(grid == other, f"{first} and {beta.name} must be of the same voxels, but they differ; write both anew.")
    return Stored((finite(f"{first}", values), finite(f"{beta}", others)), grid, of)


def write_xdmf(path: Path, grid: Grid, steps: Sequence[tuple[float, Path]], of: Contents = REFRACTION) -> None:
    """Write the series of the volumes `steps`, each with its time [s], all on `grid`, in the folder of `path`."""
    size, origin = (" ".join(map(repr, reversed(lengths))) for lengths in micrometres(grid))
    shape = " ".join(map(str, grid.shape))
    lines = ['<?xml version="1.0"?>', "<!-- lengths in um, times in s -->", '<Xdmf Version="3.0"><Domain>']
    lines.append('<Grid Name="volumes" GridType="Collection" CollectionType="Temporal">')
    for time, file in steps:
        lines += [
            f'<Grid Name="volume" GridType="Uniform"><Time Value="{time!r}"/>',
            f'<Topology TopologyType="3DCoRectMesh" Dimensions="{shape}"/>',
            '<Geometry GeometryType="ORIGIN_DXDYDZ">',
            *(f'<DataItem Format="XML" Dimensions="3">{lengths}</DataItem>' for lengths in (origin, size)),
            "</Geometry>",
        ]
        for name in of.units:
            values = f'<DataItem Format="HDF" Dimensions="{shape}" NumberType="Float" Precision="4">'
            lines.append(
                f'<Attribute Name="{name}" AttributeType="Scalar" Center="Node">{values}{escape(file.name)}:/{name}'
                "</DataItem></Attribute>"
            )
        lines.append("</Grid>")
    lines += ["</Grid>", "</Domain></Xdmf>", ""]
    with atomic_path(path) as temporary:
        temporary.write_text("\n".join(lines), encoding="utf-8")


TYPES = {"float": "f4", "double": "f8"}
ORDERS = {"little": "<", "big": ">"}
LONGEST = 1 << 16
"""Bytes of a header, at most."""
FIELD = re.compile(r"([^:#]+): (.*)")
"""A field of a header; comments begin with #, keys of other programs stand before :=."""


def write_nrrd(path: Path, obj: Object, grid: Grid, on_progress: Advance, of: Contents) -> None:
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


def read_nrrd(path: Path) -> tuple[np.ndarray, Grid, Contents]:
    """One array of NRRD: float or double, raw or gzip, axes not turned; `InputError` for other files."""
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


def write_mrc(path: Path, obj: Object, grid: Grid, on_progress: Advance, of: Contents) -> None:
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


def read_mrc(path: Path) -> tuple[np.ndarray, Grid, Contents]:
    """One array of MRC2014, of float32, lengths to seven digits; `InputError` for other files."""
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
