"""Triangle meshes from and to VTK files: legacy and XML, POLYDATA and UNSTRUCTURED_GRID, one body a file.

Files of `write_vtu` hold several, which come back apart. STL, PLY and OBJ files are read by name, too.

VTK's readers return the readable part of a damaged file and complain on stderr; here their complaints are collected and
become one `InputError`.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from ..checks import InputError, require, require_regular
from ..mesh import TriangleMesh, part_of
from ..units import LENGTH_UNITS, unit_factor
from .atomic import atomic_path
from .guard import blocks_fault, cells_fault, legacy_fault, ply_fault, xml_fault
from .lock import is_hidden

SUFFIXES = (".vtk", ".vtu", ".vtp")
MERGE_TOLERANCE = 1e-6
"""Vertices closer than this fraction of the mesh's diagonal are one vertex, written several times."""
SMALLEST, FARTHEST = 1e-9, 10.0
"""Extent of a body, at least, and how far from its origin it may reach, at most [m]."""
SOLIDS = {
    ".stl": ("vtkIOGeometry", "vtkSTLReader"),
    ".ply": ("vtkIOPLY", "vtkPLYReader"),
    ".obj": ("vtkIOGeometry", "vtkOBJReader"),
}
"""Formats of solid bodies beside VTK's own: their modules and readers in VTK."""
TRIANGLE, STRIP = 5, 6
FLAT_CELLS = (TRIANGLE, STRIP, 7, 9)
"""VTK's numbers of flat cells whose corners run around the rim or along the strip: triangle to quad."""
BODY = "body"
"""Cell data of a file of several bodies: the number of each triangle's body."""


def read_meshes(paths: str | Path | Iterable[str | Path], length_unit: str) -> list[TriangleMesh]:
    """One mesh [m] a file, named by its file name, with duplicate vertices merged and their order kept; of a file of
    `write_vtu`, one a body, named body000 and so on.

    paths: a file, a folder (its .vtk, .vtu, .vtp files, cell2 before cell10), or several of either;
    length_unit: of the files' coordinates ("um", "m", …), which VTK files do not record.
    Strips, quads and polygons are cut into triangles; of solid cells the boundary is taken. `InputError`
    names the file that is missing, damaged, truncated, no VTK file, or holds no triangles.
    """
    factor = unit_factor("length_unit", length_unit, LENGTH_UNITS)
    return [mesh for file in mesh_files(paths) for mesh in _read_file(file, factor)]


def mesh_files(paths: str | Path | Iterable[str | Path]) -> list[Path]:
    """The files that `read_meshes` reads, in its order."""
    several = [paths] if isinstance(paths, (str, Path)) else list(paths)
    files = [file for path in several for file in _files(Path(path))]
    require(len(files) > 0, "mesh files must be at least one, but the list of paths is empty.")
    return files


def write_mesh(path: str | Path, mesh: TriangleMesh, length_unit: str = "um") -> None:
    """Write `mesh` as VTK polydata in `length_unit`.

    XML for the suffix .vtp, which ParaView's collections ask for, else legacy binary (version 4.2, which all readers
    take), with the mesh's name as title.
    """
    from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray
    from vtkmodules.vtkCommonCore import vtkPoints
    from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData
    from vtkmodules.vtkIOLegacy import vtkPolyDataWriter
    from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter

    points, cells, data = vtkPoints(), vtkCellArray(), vtkPolyData()
    scaled = mesh.vertices / unit_factor("length_unit", length_unit, LENGTH_UNITS)
    points.SetData(numpy_to_vtk(np.ascontiguousarray(scaled), deep=True))
    rows = np.concatenate([np.full((len(mesh.faces), 1), 3), mesh.faces], axis=1)
    cells.ImportLegacyFormat(numpy_to_vtkIdTypeArray(np.ascontiguousarray(rows.reshape(-1)), deep=True))
    data.SetPoints(points)
    data.SetPolys(cells)
    if Path(path).suffix.lower() == ".vtp":
        writer = vtkXMLPolyDataWriter()
    else:
        writer = vtkPolyDataWriter()
        writer.SetFileVersion(writer.VTK_LEGACY_READER_VERSION_4_2)
        writer.SetFileTypeToBinary()
        writer.SetHeader(f"{mesh.name[:200]} length_unit={length_unit}".replace("\n", " "))
    save(path, writer, data)


def save(path: str | Path, writer: Any, data: Any) -> None:
    """Write `data` by a `writer` of VTK."""
    with atomic_path(path) as temporary, quiet() as complaints:
        writer.SetFileName(os.fsencode(temporary))
        writer.SetInputData(data)
        if not writer.Write() or complaints():
            raise InputError(f"{path} must be writable, but VTK could not write it: {complaints()}.")


def _files(path: Path) -> list[Path]:
    if path.is_dir():
        found = [file for file in path.iterdir() if file.suffix.lower() in SUFFIXES and not is_hidden(file)]
        require(len(found) > 0, f"{path} must hold mesh files ({', '.join(SUFFIXES)}), but it holds none.")
        return sorted(found, key=_natural_order)  # cell2 comes before cell10
    require(path.exists(), f"{path} must be a mesh file, but there is no such file; check the path.")
    return [path]


def _natural_order(file: Path) -> list[tuple[int, str]]:
    """Numbers in names compare as numbers."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", file.name)]


def _read_file(path: Path, factor: float) -> list[TriangleMesh]:
    with quiet() as complaints:
        data = _read_data(path)
        if complaints():
            raise _damaged(path, complaints())
        surface = _surface(path, data)
        points, faces = numbers_of(surface.GetPoints().GetData()).astype(np.float64), _triangles(surface)
        bad = int((~np.isfinite(points)).any(axis=1).sum())
        require(bad == 0, f"{path}: point coordinates must be finite, but {bad} of {len(points)} points are not.")
        parts = _bodies(data, faces)
    if len(faces) == 0:
        raise InputError(f"{path} must hold triangles, strips or polygons, but its cells are points or lines.")
    extent, farthest = factor * float(np.linalg.norm(np.ptp(points, axis=0))), factor * float(np.abs(points).max())
    require(
        extent >= SMALLEST and farthest <= FARTHEST,
        f"{path} must hold a body of {SMALLEST:g} m or more, at most {FARTHEST:g} m from its origin, but it is of "
        f"{extent:.3g} m and reaches {farthest:.3g} m from it; correct its coordinates, or say their --length-unit.",
    )
    name = os.fsencode(path.name).decode("utf-8", "replace")  # what is no UTF-8 in it becomes a sign for that
    whole = TriangleMesh(points * factor, faces, name)
    named = [part_of(whole, part, name) for name, part in parts.items()] or [whole]
    meshes = [mesh.merged(MERGE_TOLERANCE * extent) for mesh in named]
    if _ends_within_a_line(path) and not all(_is_closed(mesh.faces) for mesh in meshes):
        raise _damaged(path, "it ends in the middle of a line and its surface is not closed")
    return meshes


def _bodies(data: Any, faces: np.ndarray) -> dict[str, np.ndarray]:
    """The triangles of each body of a file of `write_vtu` by its name; empty for other files."""
    numbers = data.GetCellData().GetArray(BODY)
    if numbers is None or numbers.GetNumberOfValues() != len(faces):
        return {}
    of = numbers_of(numbers)
    return {f"{BODY}{number:03.0f}": faces[of == number] for number in np.unique(of)}


def _damaged(path: Path, reason: str) -> InputError:
    return InputError(f"{path} must be a complete mesh file, but it is truncated or damaged: {reason}.")


def _read_data(path: Path) -> Any:
    """The data set that VTK reads from `path`, or `InputError` where it does not start like a VTK file."""
    from vtkmodules.vtkIOLegacy import vtkGenericDataObjectReader
    from vtkmodules.vtkIOXML import vtkXMLPolyDataReader, vtkXMLUnstructuredGridReader

    require_regular(path, "a mesh file")
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path} must be a readable file, but reading it failed: {error}.") from None
    if path.suffix.lower() in SOLIDS:
        module, name = SOLIDS[path.suffix.lower()]
        if fault := _solid_fault(path.suffix.lower(), content):
            raise _damaged(path, fault)
        return _output(getattr(import_module(f"vtkmodules.{module}"), name)(), path)
    xml = re.search(rb"<VTKFile[^>]*?\btype\s*=\s*[\"'](\w+)[\"']", content[:4096])
    kind = xml[1].decode() if xml else "legacy" if content.startswith(b"# vtk DataFile") else "none"
    readers = {
        "legacy": vtkGenericDataObjectReader,
        "PolyData": vtkXMLPolyDataReader,
        "UnstructuredGrid": vtkXMLUnstructuredGridReader,
    }
    if kind not in readers:
        what = f"it holds {kind}" if xml else "it does not start like one" if content else "it is empty"
        raise InputError(f"{path} must be a VTK file of PolyData or UnstructuredGrid, but {what}.")
    if xml and b"</VTKFile>" not in content[-4096:]:  # VTK may fill in what is missing of appended data
        raise _damaged(path, "its closing tag </VTKFile> is missing")
    if fault := (xml_fault(content) or blocks_fault(content)) if xml else legacy_fault(content):
        raise _damaged(path, fault)
    return _output(readers[kind](), path)


def _output(reader: Any, path: Path) -> Any:
    """What a `reader` of VTK makes of the file at `path`."""
    reader.SetFileName(os.fsencode(path))
    reader.Update()
    return reader.GetOutput()


def _solid_fault(suffix: str, content: bytes) -> str:
    """The fault of an STL or PLY file; VTK does not see where a binary STL file was cut off."""
    if suffix == ".stl" and not content.lstrip().startswith(b"solid"):
        wanted = 84 + 50 * int.from_bytes(content[80:84], "little")
        return f"it has {len(content)} bytes of {wanted}" if len(content) < wanted else ""
    return ply_fault(content) if suffix == ".ply" else ""


def _surface(path: Path, data: Any) -> Any:
    """`data` as vtkPolyData, points in their order; of solid cells the boundary."""
    from vtkmodules.vtkFiltersGeometry import vtkGeometryFilter

    if data is None or not data.IsA("vtkPointSet"):
        kind = "nothing" if data is None else data.GetClassName()
        raise InputError(f"{path} must hold a surface (PolyData or UnstructuredGrid), but it holds {kind}.")
    count = data.GetNumberOfPoints()
    if count == 0 or data.GetNumberOfCells() == 0:
        raise _damaged(path, f"it holds {count} points and {data.GetNumberOfCells()} cells")
    if not (data.IsA("vtkPolyData") or data.IsA("vtkUnstructuredGrid")):
        kind = data.GetClassName()
        raise InputError(f"{path} must hold PolyData or an UnstructuredGrid, but it holds {kind}.")
    if fault := cells_fault(data):
        raise _damaged(path, fault)
    if data.IsA("vtkPolyData"):
        return data
    flat = _flat_cells(data)
    if flat is not None:
        return flat
    boundary = vtkGeometryFilter()
    boundary.SetInputData(data)
    boundary.Update()
    return boundary.GetOutput()


def _flat_cells(grid: Any) -> Any | None:
    """An unstructured grid's flat cells as vtkPolyData; None unless they are all strips, or none is."""
    from vtkmodules.vtkCommonDataModel import vtkPolyData

    kinds = set(numbers_of(grid.GetDistinctCellTypesArray()).tolist())
    if not kinds <= set(FLAT_CELLS) or (STRIP in kinds and len(kinds) > 1):
        return None
    surface = vtkPolyData()
    surface.SetPoints(grid.GetPoints())
    (surface.SetStrips if STRIP in kinds else surface.SetPolys)(grid.GetCells())
    return surface


def _triangles(surface: Any) -> np.ndarray:
    """Triangles [F, 3] of a vtkPolyData's polygons and strips; its lines and loose points are left out."""
    from vtkmodules.vtkFiltersCore import vtkTriangleFilter

    cut = vtkTriangleFilter()
    cut.PassLinesOff()
    cut.PassVertsOff()
    cut.SetInputData(surface)
    cut.Update()
    polygons = cut.GetOutput().GetPolys()
    return numbers_of(polygons.GetConnectivityArray()).reshape(-1, 3).astype(np.int64)


def numbers_of(vtk_array: Any) -> np.ndarray:
    """The values of an array of VTK."""
    from vtkmodules.util.numpy_support import vtk_to_numpy

    return vtk_to_numpy(vtk_array)


def _ends_within_a_line(path: Path) -> bool:
    """Whether a legacy ASCII file lacks its last line's end: its last number may be cut, unseen by VTK."""
    with path.open("rb") as file:
        head = file.read(1024).split(b"\n", 3)
        file.seek(-1, 2)
        last = file.read(1)
    return len(head) > 2 and head[2].strip().upper() == b"ASCII" and not last.isspace()


def _is_closed(faces: np.ndarray) -> bool:
    sides = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    return bool((np.unique(sides, axis=0, return_counts=True)[1] == 2).all())


@contextmanager
def quiet() -> Iterator[Callable[[], str]]:
    """VTK's messages kept off stderr; yields a function that tells the first error so far ("" if none)."""
    from vtkmodules.vtkCommonCore import vtkLogger, vtkOutputWindow, vtkStringOutputWindow

    window, before = vtkStringOutputWindow(), vtkOutputWindow.GetInstance()
    verbosity = vtkLogger.GetCurrentVerbosityCutoff()
    vtkOutputWindow.SetInstance(window)
    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_OFF)
    try:
        yield lambda: _first_error(window.GetOutput())
    finally:
        vtkLogger.SetStderrVerbosity(verbosity)
        vtkOutputWindow.SetInstance(before)


def _first_error(messages: str | bytes) -> str:
    """The first error in VTK's output, which reads 'ERROR: In file, line n', then 'class (address): text'.

    Reading past the end is a "Generic Warning"; plain warnings (a newer file version) do no harm.
    """
    if isinstance(messages, bytes):  # it quotes bytes of the file that are no text
        messages = messages.decode(errors="replace")
    found = re.search(r"(?:ERROR|Generic Warning): In [^\n]*\n(?:\w+ \(0x[0-9a-f]+\): )?([^\n]*)", messages)
    return found.group(1).split(" for file:")[0].strip(" .!") if found else ""
