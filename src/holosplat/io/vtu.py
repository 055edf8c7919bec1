"""All bodies of one time in one file of VTK's unstructured grids (.vtu): triangles in µm, with data of their bodies.

Cell data: `body`, its number from 0 on; `delta` (`mu_per_m` where δ is not known), `beta` of its matter; `volume_m3`,
what it encloses. Field data: `length_unit_m`, a number: some readers take no texts.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..checks import require
from ..matter import Matter
from ..mesh import TriangleMesh
from ..units import LENGTH_UNITS
from .plain_values import LENGTH_UNIT
from .volumes import REFRACTION, Contents
from .vtk import BODY, TRIANGLE, save


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
