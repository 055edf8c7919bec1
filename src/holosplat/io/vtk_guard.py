"""Checks that VTK lacks: cells of a damaged file that reach beyond their arrays crash it.

Both functions return the fault, or "" if there is none, for a message that names the file.
"""

from __future__ import annotations

import base64
import re
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import numpy as np

from .guard import APPENDED, LONGEST, RATIO, SMALL

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
            if len(count) > LONGEST or int(count) > 8 * len(file):  # bits are the shortest of its values
                return f"it declares {count.decode()[:LONGEST]} values, but has {len(file)} bytes"
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


def ply_fault(content: bytes) -> str:
    """The fault in the counts of a PLY file."""
    header = content[: content.find(b"end_header") + 1 or len(content)]
    for count in ELEMENT.findall(header):
        if len(count) > LONGEST or int(count) > len(content):
            return f"it declares {count.decode()[:LONGEST]} elements, but has {len(content)} bytes"
    return ""


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
    """The fault in the cells of a vtkPolyData or vtkUnstructuredGrid: corners that are no points, or too few or too
    many corners for the cell's type."""
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
