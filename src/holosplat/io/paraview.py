"""Files of ParaView, PyVista and VisIt: volumes as image data, bodies as grids, times as collections.

Volumes (.vti): δ and β as point data, lengths in µm. Points are voxel centres. The values are appended to the XML as
they are, so that writing takes no memory for them.

All bodies of one time in one file of VTK's unstructured grids (.vtu): triangles in µm, with data of their bodies.
Cell data: `body`, its number from 0 on; `delta` (`mu_per_m` where δ is not known), `beta` of its matter; `volume_m3`,
what it encloses. Field data: `length_unit_m`, a number: some readers take no texts.

Time series of mesh files: ParaView's collection (.pvd), and the snapshots that a folder or a list of files has.
ParaView opens only VTK's XML files from a collection, such as .vtp and .vtu, and no legacy .vtk; `read_pvd` takes both.
A body's files have the same name except for the number at the end: `rbc03_007.vtk` is body `rbc03`, snapshot 7.
"""

from __future__ import annotations

import math
import os
import re
import struct
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np

from ..checks import InputError, positive, require, require_regular
from ..geometry import Grid
from ..matter import Matter
from ..mesh import TriangleMesh, joined
from ..progress import Advance
from ..tables import number_in
from ..units import LENGTH_UNITS, TIME_UNITS, unit_factor
from ..volume import Object
from .atomic import atomic_path
from .guard import blocks_fault, require_declared, require_memory, xml_fault
from .hdf5 import require_room
from .plain_values import LENGTH_UNIT, fill, micrometres
from .volumes import NAMES, REFRACTION, Contents, Stored, contents_of, grid_of
from .vtk import BODY, TRIANGLE, mesh_files, numbers_of, quiet, save

UNIT = "length_unit"
"""The field array that says the unit of lengths."""
EXTENT = re.compile(rb"Extent\s*=\s*[\"']([^\"']*)[\"']")
COMPONENTS = re.compile(rb"\bNumberOfComponents\s*=\s*[\"']\s*(\d{1,4})\s*[\"']")
END = b"\n</AppendedData>\n</VTKFile>\n"


def write_vti(path: Path, obj: Object, grid: Grid, on_progress: Advance, of: Contents) -> None:
    """Write δ and β of `obj` on `grid`, slab by slab."""
    head, bytes_each = _head(grid, of), 4 * math.prod(grid.shape)
    starts = [len(head) + 8 + k * (8 + bytes_each) for k in range(len(NAMES))]
    require_room(path, starts[-1] + bytes_each)
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        file.write(head)
        for start in starts:
            file.seek(start - 8)
            file.write(struct.pack("<Q", bytes_each))
        fill([(file, start) for start in starts], obj, grid, on_progress, of)
        file.seek(starts[-1] + bytes_each)
        file.write(END)


def _head(grid: Grid, of: Contents) -> bytes:
    """The XML before the values."""
    extent = " ".join(f"0 {n - 1}" for n in reversed(grid.shape))
    size, origin = (" ".join(map(repr, lengths)) for lengths in micrometres(grid))
    offsets = [k * (8 + 4 * math.prod(grid.shape)) for k in range(len(NAMES))]
    arrays = "".join(
        f'<DataArray type="Float32" Name="{name}" format="appended" offset="{offset}"/>\n'
        for name, offset in zip(of.units, offsets)
    )
    unit = " ".join(str(code) for code in (*LENGTH_UNIT.encode(), 0))
    return (
        '<?xml version="1.0"?>\n'
        '<VTKFile type="ImageData" version="1.0" byte_order="LittleEndian" header_type="UInt64">\n'
        f'<ImageData WholeExtent="{extent}" Origin="{origin}" Spacing="{size}">\n'
        f'<FieldData><DataArray type="String" Name="{UNIT}" NumberOfTuples="1" format="ascii">{unit}</DataArray>'
        f'</FieldData>\n<Piece Extent="{extent}">\n<PointData Scalars="{next(iter(of.units))}">\n{arrays}'
        '</PointData>\n</Piece>\n</ImageData>\n<AppendedData encoding="raw">\n_'
    ).encode()


def read_vti(path: Path) -> Stored:
    """The volume of a .vti file with point data delta, beta and field data length_unit; `InputError` for others."""
    from vtkmodules.vtkIOXML import vtkXMLImageDataReader

    _require_honest(path)
    with quiet() as complaints:
        reader = vtkXMLImageDataReader()
        reader.SetFileName(os.fsencode(path))  # pyright: ignore[reportArgumentType]  # which takes bytes, too
        reader.Update()
        image = reader.GetOutput()
        require(not complaints(), f"{path} must be a complete .vti file, but it is damaged: {complaints()}.")
    data, unit = image.GetPointData(), image.GetFieldData().GetAbstractArray(UNIT)
    of = contents_of(_names(data))
    arrays = [data.GetArray(name) for name in of.units]
    sizes = [None if one is None else (one.GetNumberOfComponents(), one.GetNumberOfTuples()) for one in arrays]
    if unit is None or unit.GetNumberOfValues() != 1 or sizes != [(1, image.GetNumberOfPoints())] * 2:
        raise InputError(
            f"{path} must have the point data delta and beta, a number a point, and the field data {UNIT}, as "
            f"`holosplat export` writes them, but it has the point data {_names(data)} and the field data "
            f"{_names(image.GetFieldData())}."
        )
    turned = [image.GetDirectionMatrix().GetElement(i, j) for i in range(3) for j in range(3)]
    require(
        turned == np.eye(3).ravel().tolist(), f"{path} must have axes that are not turned, but its direction is set."
    )
    factor = unit_factor(f"{path}: {UNIT}", str(unit.GetVariantValue(0).ToString()), LENGTH_UNITS)
    shape = image.GetDimensions()[::-1]
    low = np.array(image.GetOrigin()) + np.array(image.GetSpacing()) * np.array(image.GetExtent()[::2])
    grid = grid_of(path, shape, [factor * v for v in image.GetSpacing()], [factor * v for v in low])
    first, beta = (numbers_of(array).reshape(shape) for array in arrays)
    return Stored((first, beta), grid, of)


def _require_honest(path: Path) -> None:
    """`InputError` before VTK makes room for what a file only declares."""
    require_regular(path, "a .vti file")
    content = path.read_bytes()
    found = re.search(rb"<VTKFile[^>]*?\btype\s*=\s*[\"'](\w+)[\"']", content[:4096])
    whole = found is not None and found[1] == b"ImageData" and b"</VTKFile>" in content[-4096:]
    require(whole, f"{path} must be a complete file of VTK's image data (.vti), but it is cut off, or another file.")
    if fault := xml_fault(content) or blocks_fault(content):
        raise InputError(f"{path} must be a complete .vti file, but it is damaged: {fault}.")
    components = sum(map(int, COMPONENTS.findall(content))) + content.count(b"<DataArray")
    for extent in EXTENT.findall(content):
        try:
            bounds = np.array(extent.split(), dtype=np.int64).reshape(3, 2)
        except (ValueError, OverflowError):
            raise InputError(f"{path} must have extents of six whole numbers, but one is {extent[:80]!r}.") from None
        points = math.prod(1 + int(high) - int(low) for low, high in bounds)
        require_declared(str(path), 4 * points * components, len(content))
        require_memory(str(path), 4 * points * components)


def _names(data: Any) -> str:
    return ", ".join(str(data.GetArrayName(k)) for k in range(data.GetNumberOfArrays())) or "none"


def write_vtu(path: Path, bodies: Sequence[TriangleMesh], matter: Sequence[Matter], of: Contents = REFRACTION) -> None:
    """Write `bodies`, each of its `matter`; `read_meshes` takes them apart again."""
    from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray
    from vtkmodules.vtkCommonCore import vtkPoints
    from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkUnstructuredGrid
    from vtkmodules.vtkIOXML import vtkXMLUnstructuredGridWriter

    require(len(bodies) > 0, f"{path} needs at least one body.")
    whole = joined(bodies)
    places, corners = whole.vertices / LENGTH_UNITS[LENGTH_UNIT], whole.faces
    number = np.repeat(np.arange(len(bodies), dtype=np.int32), [len(body.faces) for body in bodies])
    constants = [of.of_matter(each) for each in matter]
    data = {name: np.array([each[name] for each in constants])[number] for name in constants[0]}
    data = {BODY: number, **data, "volume_m3": np.array([body.volume for body in bodies])[number]}

    grid, points, cells = vtkUnstructuredGrid(), vtkPoints(), vtkCellArray()
    points.SetData(numpy_to_vtk(np.ascontiguousarray(places), deep=True))
    rows = np.insert(corners, 0, 3, axis=1)
    cells.ImportLegacyFormat(numpy_to_vtkIdTypeArray(np.ascontiguousarray(rows.reshape(-1)), deep=True))
    grid.SetPoints(points)
    grid.SetCells(TRIANGLE, cells)
    for name, values in data.items():
        array = numpy_to_vtk(values, deep=True)
        array.SetName(name)
        grid.GetCellData().AddArray(array)
    unit = numpy_to_vtk(np.array([LENGTH_UNITS[LENGTH_UNIT]]), deep=True)
    unit.SetName("length_unit_m")
    grid.GetFieldData().AddArray(unit)
    save(path, vtkXMLUnstructuredGridWriter(), grid)


@dataclass(frozen=True)
class TimeStep:
    """The files, one a body in the order of their names, of one instant `time` [s]."""

    time: float
    files: tuple[Path, ...]


def write_pvd(path: str | Path, steps: Sequence[TimeStep]) -> None:
    """Write the collection `path`, with files relative to its folder; `InputError` for infinite times and legacy
    files."""
    folder = Path(path).resolve().parent
    lines = ['<?xml version="1.0"?>', '<VTKFile type="Collection" version="0.1">', "  <!-- timestep in seconds -->"]
    lines.append("  <Collection>")
    for step in steps:
        require(math.isfinite(step.time), f"{path}: times must be finite, but one is {step.time}; correct it.")
        for part, file in enumerate(step.files):
            legacy = Path(file).suffix.lower() == ".vtk"
            require(
                not legacy, f"{path} must name XML files (.vtp, .vtu), but {file} is a legacy one; write it as .vtp."
            )
            name = quoteattr(Path(os.path.relpath(Path(file).resolve(), folder)).as_posix())
            lines.append(f'    <DataSet timestep="{step.time!r}" part="{part}" file={name}/>')
    lines += ["  </Collection>", "</VTKFile>", ""]
    with atomic_path(path) as temporary:
        temporary.write_text("\n".join(lines), encoding="utf-8")


def read_pvd(path: str | Path) -> list[TimeStep]:
    """The instants of a collection in the order of time, files in the order of parts. Errors: `InputError` for a
    missing or other file, for missing files in it, and for none or no time."""
    require_regular(path, "a ParaView collection (.pvd)")
    try:
        root = ElementTree.fromstring(Path(path).read_bytes())
    except (OSError, ElementTree.ParseError) as error:
        raise InputError(f"{path} must be a readable ParaView collection (.pvd), but it is not: {error}.") from None
    require(root.tag == "VTKFile", f"{path} must be a ParaView collection (.pvd), but it holds {root.tag}.")
    found: dict[float, list[tuple[int, Path]]] = {}
    for entry in root.iterfind("./Collection/DataSet"):
        file = Path(path).parent / entry.get("file", "")
        require(file.is_file(), f"{path} names {entry.get('file')!r}, but there is no such file; check the folder.")
        time, part = _number(path, entry, "timestep", "nan"), _number(path, entry, "part", "0")
        found.setdefault(time, []).append((int(part), file))
    require(len(found) > 0, f"{path} must name at least one file, but it names none; write it anew.")
    return [TimeStep(time, tuple(file for _, file in sorted(files))) for time, files in sorted(found.items())]


def _number(path: str | Path, entry: ElementTree.Element, name: str, default: str) -> float:
    number = number_in(entry.get(name, default))
    require(
        math.isfinite(number),
        f"{path}: {name} of {entry.get('file')!r} must be a number, but it is {entry.get(name)!r}; write it anew.",
    )
    return number


NUMBERED = re.compile(r"(?P<body>.*?)[_.\-]?(?P<number>\d+)")
HEADER_TIME = re.compile(r"\bt(?:ime)?\s*=\s*([-+]?[\d.]+(?:[eE][-+]?\d+)?)\s*([A-Za-zµ]+)")
"""How a time stands in the second line of a legacy VTK file: `t=17.7us`."""
COLLECTION = ".pvd"


def find_snapshots(
    paths: Sequence[Path], interval: float | None = None, time_unit: str | None = None
) -> list[TimeStep]:
    """Snapshots in the order of time, all of the same bodies.

    paths: one collection (.pvd), or numbered mesh files and folders of them. The times are `interval` [s] apart, if it
    is given; else the times in the headers of legacy VTK files (`t=17.7us`); else the time steps of the collection, in
    `time_unit` (default: seconds). Errors: `InputError` for names without a number, bodies that are missing in some
    snapshot, a damaged collection, and missing times.
    """
    collections = [path for path in paths if path.suffix.lower() == COLLECTION]
    require(
        not collections or len(paths) == 1, f"a collection ({COLLECTION}) must be given alone, without other meshes."
    )
    require(
        time_unit is None or bool(collections), f"a time unit goes with a collection ({COLLECTION}), which has none."
    )
    if collections:
        listed = {step.time: list(step.files) for step in read_pvd(collections[0])}
        factor = unit_factor("time unit", time_unit or "s", TIME_UNITS)
        said = {key: key * factor for key in listed}
    else:
        listed, said = dict[float, list[Path]](), {}
        for file in mesh_files(paths):
            if (match := NUMBERED.fullmatch(file.stem)) is None:
                raise InputError(
                    f"{file} must end with the number of its snapshot, such as cell00_007.vtk, to be part of a series."
                )
            listed.setdefault(float(match["number"]), []).append(file)
    keys = sorted(listed)
    ordered = [_in_order(listed[key]) for key in keys]
    for bodies in ordered[1:]:
        if lost := sorted(ordered[0].keys() ^ bodies.keys()):
            has, lacks = (ordered[0], bodies) if lost[0] in ordered[0] else (bodies, ordered[0])
            raise InputError(
                f"every snapshot must hold the same bodies, but {has[lost[0]].name} has no match beside "
                f"{next(iter(lacks.values())).name}; add it, or leave the snapshot out."
            )
    if interval is not None:
        step = positive("snapshot interval", interval, "seconds")
        counts = np.arange(len(keys)) if collections else np.array(keys) - keys[0]
        times = [float(step * count) for count in counts]
    else:
        times = [_time(list(bodies.values()), said.get(key)) for key, bodies in zip(keys, ordered)]
    found = [TimeStep(time, tuple(bodies.values())) for time, bodies in zip(times, ordered)]
    for before, after in pairwise(found):
        require(
            after.time > before.time,
            f"snapshots must follow one another in time, but {after.files[0].name}, at {after.time:g} s, is not after "
            f"{before.files[0].name}, at {before.time:g} s; correct the files, or give --snapshot-interval.",
        )
    return found


def seeming_snapshots(paths: Sequence[Path]) -> int:
    """How many snapshots the names of mesh files say: of two bodies or more, each with all the numbers; else 1."""
    numbers: dict[str, set[int]] = {}
    for file in mesh_files(paths):
        if (match := NUMBERED.fullmatch(file.stem)) is None:
            return 1
        numbers.setdefault(match["body"], set()).add(int(match["number"]))
    first, *others = numbers.values()
    return len(first) if others and all(other == first for other in others) else 1


def _in_order(files: list[Path]) -> dict[str, Path]:
    """Files by body, in the order of the bodies' names."""
    bodies: dict[str, Path] = {}
    for file in files:
        match = NUMBERED.fullmatch(file.stem)
        body = match["body"] if match else file.stem
        if body in bodies:
            raise InputError(f"{file} and {bodies[body]} are the same body at the same time; keep one of them.")
        bodies[body] = file
    return dict(sorted(bodies.items()))


def _time(files: list[Path], said: float | None) -> float:
    """Time [s] of one snapshot, from its files' headers, or else from the collection."""
    times = {_header_time(file) for file in files}
    if len(times) > 1:
        raise InputError(f"the files of one snapshot must be of one time, but {files[0].name} and others differ.")
    time = said if (found := times.pop()) is None else found
    if time is None:
        raise InputError(f"{files[0]} does not say its time (t=17.7us in the second line); give --snapshot-interval.")
    return time


def _header_time(file: Path) -> float | None:
    require_regular(file, "a mesh file")
    try:
        with file.open("rb") as opened:
            lines = opened.read(512).split(b"\n")
    except OSError as error:
        raise InputError(f"{file} must be a readable file, but reading it failed: {error}.") from None
    if len(lines) < 2 or not lines[0].startswith(b"# vtk DataFile"):
        return None
    match = HEADER_TIME.search(lines[1].decode(errors="replace"))
    if match is None:
        return None
    try:
        return float(match[1]) * unit_factor(f"{file}: the time in its header", match[2], TIME_UNITS)
    except ValueError as error:
        raise error if isinstance(error, InputError) else InputError(f"{file}: {match[0]!r} is no time.") from None
