"""Bodies of known rest shape: red cells, or any closed mesh, as fine as they are needed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..checks import InputError, at_least, in_range, require
from ..io.vtk import read_meshes
from ..mesh import TriangleMesh
from ..ranges import Metres, Weight, ranged
from ..specimens.membrane.resting import FREQUENCIES, resting_cell
from ..specimens.repair import closed
from .moments import centroid

RED_CELL = "red-cell"
LEAST_PX, MOST_PX = 3.0, 300.0
"""Least radius [pixels] of the ball of a body's volume at which frames determine its orientation."""
GUESSED = 0.15
"""By which part all red cells may be larger or smaller than a guess of them, whose volumes are hardly better."""
COARSE, FEWEST, MOST = 180, 180, 3000
"""Triangles in the search, and in the fit at least and at most: there one has the area of a pixel."""


@dataclass(frozen=True)
@ranged
class KnownBody:
    """The known shape that all bodies share."""

    shape: str = RED_CELL
    """red-cell, or a file of one closed mesh (.stl, .ply, .obj, .vtk, .vtp, .vtu); its pose there does not matter."""
    length_unit: str = "um"
    """Unit of the file's coordinates."""
    size: Metres = 0.0
    """Largest extent at rest [m] (0: a red cell's 7.82 µm, or the file's)."""
    uncertain: float = 0.1
    """Largest relative change of the size of all bodies, which is fitted (0: fixed)."""
    stiffness: Weight = 100.0
    """Minus the logarithm of the probability of strains of about one: frames decide what they see, this the rest."""
    instants: int = 9
    """Times of the scan at which bodies are looked for together."""

    def __post_init__(self) -> None:
        at_least(self, 2, "instants")
        in_range("uncertain", self.uncertain, 0, 0.3)
        known = self.shape == RED_CELL or Path(self.shape).is_file()
        require(
            known, f"the body must be {RED_CELL} or a mesh file that exists, but it is {self.shape!r}; correct --body."
        )

    def mesh(self, pixel: float, coarse: bool = False) -> TriangleMesh:
        """At rest about its centre of volume, in units of `pixel` [m]; coarse: of as many triangles as a search needs.

        Errors: `InputError` for a file without one closed mesh, and a body that is absurd beside a pixel.
        """
        found = resting_cell() if self.shape == RED_CELL else self._read()
        factor = self.size / float(np.ptp(found.vertices, axis=0).max()) if self.size else 1.0
        radius = factor * (3 * found.volume / (4 * np.pi)) ** (1 / 3) / pixel
        if not LEAST_PX <= radius <= MOST_PX:
            raise InputError(
                f"a body of known shape must have a radius of {LEAST_PX:g} to {MOST_PX:g} pixels, but this one has "
                f"{radius:.3g}; check the size or length_unit of the body, and the pixel size."
            )
        wanted = COARSE if coarse else int(np.clip(surface(found) * (factor / pixel) ** 2, FEWEST, MOST))
        if self.shape == RED_CELL:
            found = resting_cell(int(np.clip(round((wanted / 20) ** 0.5), *FREQUENCIES)))
        else:
            found = thinned(found, wanted)
        return replace(found, vertices=(found.vertices - centroid(found)) * factor / pixel)

    def _read(self) -> TriangleMesh:
        meshes = read_meshes(self.shape, self.length_unit)
        require(len(meshes) == 1, f"{self.shape} must hold one body, but it holds {len(meshes)}; name a file of one.")
        return closed(meshes[0], self.length_unit)


def extent_like(meshes: Sequence[TriangleMesh]) -> float:
    """Largest extent [m] of a red cell at rest as large as most of the matter's `meshes` [m].

    Its volume is their median by volume: a guess has pieces of cells beside whole ones, which may be more, but not of
    more matter.
    """
    rest, volumes = resting_cell(), np.sort([mesh.volume for mesh in meshes])[::-1]
    whole = volumes.cumsum()
    middle = float(volumes[np.searchsorted(whole, 0.5 * whole[-1])])
    return (middle / rest.volume) ** (1 / 3) * float(np.ptp(rest.vertices, axis=0).max())


def guessed_cells(extent: float) -> KnownBody:
    """Red cells of about that largest extent [m], as guesses of them have it."""
    return KnownBody(size=extent, uncertain=GUESSED)


def surface(mesh: TriangleMesh) -> float:
    """Its area, in the squared unit of its vertices."""
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    return 0.5 * float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())


def thinned(mesh: TriangleMesh, triangles: int) -> TriangleMesh:
    """`mesh` of at most about so many triangles (Garland & Heckbert 1997, as VTK does it), of the same volume."""
    if len(mesh.faces) <= triangles:
        return mesh
    from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray, vtk_to_numpy
    from vtkmodules.vtkCommonCore import vtkPoints
    from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData
    from vtkmodules.vtkFiltersCore import vtkQuadricDecimation

    unit = float(np.ptp(mesh.vertices, axis=0).max())
    points, cells, data = vtkPoints(), vtkCellArray(), vtkPolyData()
    points.SetData(numpy_to_vtk(mesh.vertices / unit, deep=True))
    cells.SetData(3, numpy_to_vtkIdTypeArray(mesh.faces.ravel(), deep=True))
    data.SetPoints(points)
    data.SetPolys(cells)
    decimation = vtkQuadricDecimation()
    decimation.SetInputData(data)
    decimation.SetTargetReduction(1 - triangles / len(mesh.faces))
    decimation.VolumePreservationOn()
    decimation.Update()
    output = decimation.GetOutput()
    vertices = unit * vtk_to_numpy(output.GetPoints().GetData()).astype(np.float64)
    faces = vtk_to_numpy(output.GetPolys().GetConnectivityArray()).reshape(-1, 3).astype(np.int64)
    found = closed(TriangleMesh(vertices, faces, mesh.name))
    middle = centroid(found)
    return replace(found, vertices=middle + (found.vertices - middle) * (mesh.volume / found.volume) ** (1 / 3))
