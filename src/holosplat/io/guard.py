"""Input that nobody vouches for: it declares no more than it can hold.

VTK crashes on cells of a damaged file that reach beyond their arrays. Functions for its files return the fault, or ""
if there is none, for a message that names the file.
"""

from __future__ import annotations

import base64
import re
import zipfile
import zlib
from collections.abc import Container, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from ..checks import LONGEST as SAID
from ..checks import InputError, require, require_regular
from .room import machine_memory

RATIO = 1100
"""Declared bytes over those of a file, at most: deflate makes zeros 1032 times smaller."""
SMALL = 1 << 26
"""Bytes that any file may declare."""
DEEPEST = 64
"""Levels of nested elements, groups or tables, at most."""
TAG = re.compile(rb"<(/?)([A-Za-z!?][^\s>/]*)[^>]*?(/?)>")
COUNT = re.compile(rb"\b(NumberOf\w+)\s*=\s*[\"']\s*(\d+)\s*[\"']")
MOST_COMPONENTS = 1000
"""Numbers of a point or cell in an array of VTK."""
LONGEST = 18
"""Digits of a count, at most."""
APPENDED = b"<AppendedData"


def require_declared(label: str, declared: int, held: int) -> None:
    """`InputError` if a file declares more bytes than the `held` ones can be packed into."""
    require(
        declared <= max(SMALL, RATIO * held),
        f"{label} declares {declared:.3g} bytes of values, but holds {held:.3g}; it is damaged, or no honest file.",
    )


def require_memory(label: str, size: int) -> None:
    """`InputError` if `size` bytes are more than the memory of this machine."""
    whole = machine_memory()
    require(
        size <= whole,
        f"{label} takes {size / 1e9:.3g} GB, but this machine has {whole / 1e9:.3g} GB of memory for it; "
        "take a part of it.",
    )


def require_inflated(label: str, packed: bytes, most: int) -> None:
    """`InputError` if deflated bytes become more than `most`, which unpackers other than this one would find out in
    memory. What is no deflate is left to them."""
    try:
        inflated = len(zlib.decompressobj().decompress(packed, most + 1))
    except zlib.error:
        return
    require(inflated <= most, f"{label} unpacks to more than the {most} bytes that it declares; it is no honest file.")


def read_array(path: Path, what: str) -> np.ndarray:
    """The array of numbers in a .npy file, which must be `what`; `InputError` for any other, or one cut short."""
    found = mapped_array(path, what)
    require_memory(str(path), found.nbytes)  # of a file with holes, which holds more than it takes
    return np.array(found)


def mapped_array(path: Path, what: str) -> np.ndarray:
    """The same, whose values are read when they are asked for."""
    require_regular(path, what)
    with undamaged(path, f"{what} (.npy)"):
        with path.open("rb") as file:
            declared = _declared(file)
        if declared > path.stat().st_size:
            raise ValueError(f"it declares {declared:.3g} bytes, but has {path.stat().st_size}")
        found = np.load(path, mmap_mode="r", allow_pickle=False)  # which maps no more than there is
        if not isinstance(found, np.ndarray):
            found.close()
            raise ValueError("it is an archive")
        return found


def read_archive(
    path: Path, names: Container[str] | None = None, what: str = "a NumPy archive"
) -> dict[str, np.ndarray]:
    """The arrays in an .npz file, which must be `what`, by name, of all names or those in `names`; `InputError` for any
    other file, for one that declares more than it can hold, and for more than there is memory for."""
    require_regular(path, what)
    with undamaged(path, f"{what} (.npz)"), zipfile.ZipFile(path) as archive:
        for part in archive.infolist():
            with archive.open(part) as file:
                declared = _declared(file)
            if declared > part.file_size:
                raise ValueError(f"it declares {declared:.3g} bytes of {part.filename[:40]}, but has {part.file_size}")
        size = sum(part.file_size for part in archive.infolist())
        require_declared(str(path), size, path.stat().st_size)
        require_memory(str(path), size)
        with np.load(path, allow_pickle=False) as found:
            arrays = {name: found[name] for name in found.files if names is None or name in names}
        for name, array in arrays.items():
            if not isinstance(array, np.ndarray):
                raise ValueError(f"{name[:40]} is no array")
        return arrays


@contextmanager
def undamaged(path: Path, what: str) -> Iterator[None]:
    """`InputError` in place of what libraries raise, of many kinds, for a damaged file, which must be `what`."""
    try:
        yield
    except (InputError, MemoryError):
        raise
    except Exception as error:
        said = " ".join(str(error).split())[:SAID] or type(error).__name__
        raise InputError(f"{path} must be {what}, but it is damaged or none: {said}.") from None


def _declared(file: Any) -> int:
    """Bytes that the header of an open .npy file declares; none where it is no such header, which others will say."""
    try:
        version = np.lib.format.read_magic(file)
        header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = header(file)
    except (OSError, ValueError, EOFError):
        return 0
    return int(np.prod(shape, dtype=object)) * dtype.itemsize


def xml_fault(content: bytes) -> str:
    """Why an XML file of VTK is not given to its parser: it is nested too deeply, or declares more points or cells than
    it has room for; empty if there is no such fault. What is appended to it is no XML and is passed over."""
    text = content[: content.rindex(APPENDED)] if APPENDED in content else content
    for name, count in COUNT.findall(text):
        most = MOST_COMPONENTS if name == b"NumberOfComponents" else RATIO * len(content)
        if fault := _excess(count, most, "points, cells or components", content):
            return fault
    depth = 0
    for tag in TAG.finditer(text):
        if tag[2][:1] in b"!?" or tag[3]:
            continue
        depth += -1 if tag[1] else 1
        if depth > DEEPEST:
            return f"its elements are nested more than {DEEPEST} deep"
    return ""


SECTION = re.compile(
    rb"\n[ \t]*(POLYGONS|TRIANGLE_STRIPS|LINES|VERTICES|CELLS)[ \t]+(\d+)[ \t]+(\d+)[ \t\r]*\n", re.IGNORECASE
)
ARRAY = re.compile(rb"\s*(OFFSETS|CONNECTIVITY)[ \t]+(\w+)[ \t\r]*\n", re.IGNORECASE)
INTEGERS = {b"vtktypeint64": ">i8", b"vtktypeint32": ">i4", b"int": ">i4"}
"""Binary legacy files are big-endian; files before version 5 hold 32-bit cells."""
DECLARED = re.compile(
    rb"\n[ \t]*(?:(?:POINTS|POINT_DATA|CELL_DATA|CELL_TYPES|FIELD|SCALARS|COLOR_SCALARS|LOOKUP_TABLE|VECTORS|NORMALS|"
    rb"TENSORS|TEXTURE_COORDINATES|DIMENSIONS|[XYZ]_COORDINATES|VERTICES|LINES|POLYGONS|TRIANGLE_STRIPS|CELLS)\b[^\n]{0,200}"
    rb"|[^\s]{1,200}[ \t]+\d+[ \t]+\d+[ \t]+[a-z_0-9]+[ \t\r]*(?=\n))",
    re.IGNORECASE,
)
"""Lines that say how many values follow: of VTK's keywords, and of arrays in a field."""
ELEMENT = re.compile(rb"^element[ \t]+\w+[ \t]+(\d+)", re.MULTILINE)
"""Such lines of a PLY file."""
DATA_ARRAY = re.compile(rb"<DataArray\b([^>]*)>\s*([A-Za-z0-9+/=]{0,64})")
CORNERS = {1: 1, 3: 2, 5: 3, 8: 4, 9: 4, 10: 4, 11: 8, 12: 8, 13: 6, 14: 5, 15: 10, 16: 12}
CORNERS |= {21: 3, 22: 6, 23: 8, 24: 10, 25: 20, 26: 15, 27: 13, 28: 9, 29: 27}
"""Corners of VTK's cell types that have a fixed number (linear, then quadratic ones)."""
OPEN_ENDED = {2: 1, 4: 2, 6: 3, 7: 3}
"""The least corners of a poly-vertex, poly-line, strip, polygon."""


def legacy_fault(file: bytes) -> str:
    """The fault in the counts of a legacy file, above all of its cells."""
    for line in DECLARED.finditer(file):
        for count in re.findall(rb"(?<![\w.+-])\d+(?![\w.])", line[0]):
            if fault := _excess(count, 8 * len(file), "values", file):  # bits are the shortest of its values
                return fault
    lines = file[:1024].split(b"\n", 3)
    binary = len(lines) > 2 and lines[2].strip().upper() == b"BINARY"
    version = re.match(rb".{22}[ \t]*(\d+)\.\d+", file)  # VTK too takes what it cannot read for an old version
    modern = version is not None and int(version[1]) >= 5
    for section in SECTION.finditer(file):
        name = section[1].decode().upper()
        count, size = int(section[2]), int(section[3])
        array = ARRAY.match(file, section.end())
        if modern != (array is not None):
            return f"{name} must be laid out as the version in the first line has it"
        if array is None:
            values, _ = _integers(file, section.end(), size, ">i4" if binary else "")
            fault = _counts_fault(values, count, size)
        else:
            fault = _offsets_fault(file, array, count, size, binary)
        if fault:
            return f"{name} {fault}"
    return ""


def _excess(count: bytes, most: int, what: str, content: bytes) -> str:
    """The fault of a count of more than `most`, in digits."""
    too_many = len(count) > LONGEST or int(count) > most
    return f"it declares {count.decode()[:LONGEST]} {what}, but has {len(content)} bytes" if too_many else ""


def ply_fault(content: bytes) -> str:
    """The fault in the counts of a PLY file."""
    header = content[: content.find(b"end_header") + 1 or len(content)]
    return next(
        (fault for count in ELEMENT.findall(header) if (fault := _excess(count, len(content), "elements", content))), ""
    )


def blocks_fault(content: bytes) -> str:
    """The fault in the sizes of an XML file's compressed blocks, for which VTK makes room before it unpacks them."""
    head = content[:4096]
    if b"compressor=" not in head:
        return ""
    order = ">" if b"BigEndian" in head else "<"
    dtype = np.dtype(f"{order}u{8 if b'UInt64' in head else 4}")
    for raw in _headers(content, 3 * dtype.itemsize):
        if len(raw) < 3 * dtype.itemsize:
            continue
        count, size, last = np.frombuffer(raw, dtype, 3).tolist()
        if count * size + last > max(SMALL, RATIO * len(content)):
            return f"it declares {count} blocks of {size} bytes, but has {len(content)} bytes"
    return ""


def _headers(content: bytes, size: int) -> Iterator[bytes]:
    """The first `size` bytes of each array of an XML file, in it or appended to it."""
    start = content.find(b"_", content.rindex(APPENDED)) + 1 if APPENDED in content else 0
    encoded = b'encoding="raw"' not in content[max(start - 200, 0) : start] if start else True
    for attributes, text in DATA_ARRAY.findall(content):
        offset = re.search(rb"\boffset\s*=\s*[\"'](\d{1,18})", attributes)
        if b"appended" in attributes and offset and start:
            place = start + int(offset[1])
            text = content[place : place + 64]
            if not encoded:
                yield text[:size]
                continue
        elif b"binary" not in attributes:
            continue
        with suppress(ValueError):
            yield base64.b64decode(text[: -(-size // 3) * 4])[:size]


def cells_fault(data: Any) -> str:
    """Cells of a vtkPolyData or vtkUnstructuredGrid with corners that are no points, or of a wrong number."""
    from vtkmodules.util.numpy_support import vtk_to_numpy

    points = data.GetNumberOfPoints()
    grid = data.IsA("vtkUnstructuredGrid")
    arrays = [data.GetCells()] if grid else [data.GetVerts(), data.GetLines(), data.GetPolys(), data.GetStrips()]
    for cells in (cells for cells in arrays if cells.GetNumberOfCells()):
        corners = vtk_to_numpy(cells.GetConnectivityArray())
        if len(corners) and (corners.min() < 0 or corners.max() >= points):
            wrong = corners[(corners < 0) | (corners >= points)][0]
            return f"a cell names point {wrong}, but there are {points} points, counted from 0"
    if not grid:
        return ""
    sizes = np.diff(vtk_to_numpy(data.GetCells().GetOffsetsArray()))
    types = np.array([data.GetCellType(i) for i in range(data.GetNumberOfCells())])
    for kind in np.unique(types).tolist():
        found = np.unique(sizes[types == kind])
        if kind in CORNERS and found.tolist() != [CORNERS[kind]]:
            return f"cells of type {kind} have {found.tolist()} corners instead of {CORNERS[kind]}"
        if kind not in CORNERS and found.min() < OPEN_ENDED.get(kind, np.inf):
            return f"its cells of type {kind} and {found.min()} corners are unknown"
    return ""


def _counts_fault(values: np.ndarray | None, count: int, size: int) -> str:
    """Before version 5: `count` runs of (number of corners, corners …), `size` integers in all."""
    if values is None:
        return f"must hold {size} integers"
    position = done = 0
    while done < count and 0 <= position < size:
        corners = int(values[position])
        if corners < 0:
            return f"cell {done} has {corners} corners"
        position, done = position + 1 + corners, done + 1
    return "" if (done, position) == (count, size) else f"must be {count} cells of {size} integers in all"


def _offsets_fault(file: bytes, array: re.Match[bytes], count: int, size: int, binary: bool) -> str:
    """From version 5 on: `count` offsets, the first 0 and the last `size`, then `size` corners."""
    if binary and array[2].lower() not in INTEGERS:
        return f"has the unknown integer type {array[2].decode(errors='replace')}"
    offsets, end = _integers(file, array.end(), count, INTEGERS.get(array[2].lower(), "") if binary else "")
    if offsets is None:
        return f"must hold {count} offsets"
    if count and (offsets[0] != 0 or offsets[-1] != size or np.any(np.diff(offsets) < 0)):
        return f"offsets must rise from 0 to {size}"
    return "" if ARRAY.match(file, end) else "must have its connectivity after the offsets"


def _integers(file: bytes, start: int, count: int, dtype: str) -> tuple[np.ndarray | None, int]:
    """`count` integers from byte `start` on (text for dtype ""), None if some are missing; and their end."""
    if dtype:
        end = start + count * np.dtype(dtype).itemsize
        return (np.frombuffer(file, dtype, count, start) if end <= len(file) else None), end
    following = ARRAY.search(file, start)
    end = following.start() if following else len(file)
    try:
        values = np.array(file[start:end].split(None, count)[:count], dtype=bytes).astype(np.int64)
    except (ValueError, OverflowError):
        return None, end
    return (values if len(values) == count else None), end
