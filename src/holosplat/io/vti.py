"""Volumes as VTK image data (.vti), for ParaView, PyVista and VisIt: δ and β as point data, lengths in µm.

Points are voxel centres. The values are appended to the XML as they are, so that writing takes no memory for them.

All bodies of one time in one file of VTK's unstructured grids (.vtu): triangles in µm, with data of their bodies.
Cell data: `body`, its number from 0 on; `delta` (`mu_per_m` where δ is not known), `beta` of its matter; `volume_m3`,
what it encloses. Field data: `length_unit_m`, a number: some readers take no texts.
"""

from __future__ import annotations

import math
import os
import re
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..checks import InputError, require, require_regular
from ..geometry import Grid
from ..matter import Matter
from ..mesh import TriangleMesh
from ..progress import Advance
from ..units import LENGTH_UNITS, unit_factor
from ..volume import Object
from .atomic import atomic_path
from .guard import blocks_fault, require_declared, require_memory, xml_fault
from .hdf5 import require_room
from .plain_values import LENGTH_UNIT, fill, micrometres
from .volumes import NAMES, REFRACTION, Contents, Stored, contents_of, grid_of
from .vtk import BODY, TRIANGLE, numbers_of, quiet, save

UNIT = "length_unit"
"""The field array that says the unit of lengths."""
EXTENT = re.compile(rb"Extent\s*=\s*[\"']([^\"']*)[\"']")
COMPONENTS = re.compile(rb"\bNumberOfComponents\s*=\s*[\"']\s*(\d{1,4})\s*[\"']")
END = b"\n</AppendedData>\n</VTKFile>\n"


def write_vti(
    path: Path, obj: Object, grid: Grid, on_progress: Advance = lambda fraction: None, of: Contents = REFRACTION
) -> None:
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
    """The volume of a .vti file with the point data delta and beta, and the field data length_unit, by VTK's reader.

    `InputError` for damaged files, and for other image data.
    """
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
    if unit is None or unit.GetNumberOfValues() != 1 or any(_is_none(one, image) for one in arrays):
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


def _is_none(array: Any, image: Any) -> bool:
    return array is None or array.GetNumberOfComponents() != 1 or array.GetNumberOfTuples() != image.GetNumberOfPoints()


def _names(data: Any) -> str:
    return ", ".join(str(data.GetArrayName(k)) for k in range(data.GetNumberOfArrays())) or "none"


def write_vtu(path: Path, bodies: Sequence[TriangleMesh], matter: Matter, of: Contents = REFRACTION) -> None:
    """Write `bodies`, all of `matter`; `read_meshes` takes them apart again."""
    from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray
    from vtkmodules.vtkCommonCore import vtkPoints
    from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkUnstructuredGrid
    from vtkmodules.vtkIOXML import vtkXMLUnstructuredGridWriter

    require(len(bodies) > 0, f"{path} needs at least one body.")
    before = np.cumsum([0, *(len(body.vertices) for body in bodies)])
    places = np.concatenate([body.vertices for body in bodies]) / LENGTH_UNITS[LENGTH_UNIT]
    corners = np.concatenate([body.faces + start for body, start in zip(bodies, before)])
    number = np.repeat(np.arange(len(bodies), dtype=np.int32), [len(body.faces) for body in bodies])
    data = {name: np.full(len(corners), value) for name, value in of.of_matter(matter).items()}
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
