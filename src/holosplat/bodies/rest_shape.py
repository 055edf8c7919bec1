"""Bodies of known rest shape (red cells, any closed mesh); bodies cut out of a volume; moments of meshes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from scipy import ndimage

from ..checks import InputError, require
from ..geometry import Grid, Views
from ..io.vtk import read_meshes
from ..matter import Matter
from ..mesh import TriangleMesh, ball_radius
from ..ranges import Metres, Several, Weight, Within, checked_dataclass
from ..representations import SurfaceMesh, isosurface
from ..specimens.membrane.rest import FREQUENCIES, resting_cell
from ..specimens.repair import closed

RED_CELL = "red-cell"
LEAST_PX, MOST_PX = 3.0, 300.0
"""Least radius [pixels] of the ball of a body's volume at which frames determine its orientation."""
GUESSED = 0.15
"""By which part all red cells may be larger or smaller than a guess of them, whose volumes are hardly better."""
COARSE, FEWEST, MOST = 180, 180, 3000
"""Triangles in the search, and in the fit at least and at most: there one has the area of a pixel."""


@checked_dataclass
class KnownBody:
    """The known shape that all bodies share."""

    shape: str = RED_CELL
    """red-cell, or a file of one closed mesh (.stl, .ply, .obj, .vtk, .vtp, .vtu); its pose there does not matter."""
    length_unit: str = "um"
    """Unit of the file's coordinates."""
    size: Metres = 0.0
    """Largest extent at rest [m] (0: a red cell's 7.82 µm, or the file's)."""
    uncertain: Annotated[float, Within(0, 0.3, above=True)] = 0.1
    """Largest relative change of the size of all bodies, which is fitted (0: fixed)."""
    stiffness: Weight = 100.0
    """Minus the logarithm of the probability of strains of about one: frames decide what they see, this the rest."""
    instants: Several = 9
    """Times of the scan at which bodies are looked for together."""

    def __post_init__(self) -> None:
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
        radius = factor * ball_radius(found.volume) / pixel
        if not LEAST_PX <= radius <= MOST_PX:
            raise InputError(
                f"a body of known shape must have a radius of {LEAST_PX:g} to {MOST_PX:g} pixels, but this one has "
                f"{radius:.3g}; check the size or length_unit of the body, and the pixel size."
            )
        wanted = COARSE if coarse else int(np.clip(found.area * (factor / pixel) ** 2, FEWEST, MOST))
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


LEVEL, LEAST_VOLUME, SMOOTHING, EDGE = 0.5, 30.0, 10, 1.0
"""Occupancy at the surface; pixels³ of the smallest body; steps that smooth away the voxels' traces; and distance from
the field's edge [pixels] within which a body is cut by it."""


def cut_bodies(
    values: np.ndarray,
    grid: Grid,
    pixel: float,
    level: float = LEVEL,
    least_volume: float = LEAST_VOLUME,
    smoothing: int = SMOOTHING,
) -> list[TriangleMesh]:
    """The bodies [m] where occupancy `values` [Z, Y, X] on `grid` is above `level`, the largest first; such as touch
    are parted. None where nothing reaches the level, or cavities alone do.

    pixel: of the frames [m]; least_volume: of a body [pixels³]
    """
    least = least_volume * (pixel / grid.voxel_size[0]) ** 3
    try:
        mesh = isosurface(parted(values, level, least), grid, level, least, smoothing)
        unit = torch.from_numpy(mesh.vertices / pixel)
        return SurfaceMesh(unit, torch.from_numpy(mesh.faces), pixel, Matter.one(1.0, 1.0)).bodies()
    except InputError:
        return []


def is_cut(body: TriangleMesh, views: Views, edge: float = EDGE) -> bool:
    """Whether `body` comes within `edge` pixels of the rows' ends in any view, or of the columns' in all of them.

    What one view's columns cut, others may see whole; rows are common to all views about one axis, but need not be.
    """
    seen = np.einsum("vij,pj->vpi", views.rotations[:, :2], body.vertices) - views.shifts[:, None]
    rows, columns = views.shape
    half = 0.5 * np.array([columns, rows]) * views.pixel_sizes[:, None] - edge * views.pixel_sizes[:, None]
    beyond = (np.abs(seen) > half[:, None]).any(1)  # [V, 2]: of columns, of rows
    return bool(beyond[:, 1].any() or beyond[:, 0].all())


LARGE = 1.3
"""Volumes, over the median one, from which on a body may be two: volumes of one body differ by less."""
PIECE = 0.1
"""Share of the median volume that each piece has at least, at the level at which it comes off."""
LEVELS = 10
"""Levels between the surface's and the largest occupancy at which pieces may come off."""


def parted(values: np.ndarray, level: float, least: float) -> np.ndarray:
    """Occupancy [Z, Y, X] in which bodies that touch are parted by empty voxels.

    level: occupancy at the surface; least: voxels of the bodies that count. Of a body of more than `LARGE` median
    volumes the level is raised until it falls into pieces, from which it is flooded again (watershed by markers:
    Meyer & Beucher 1990); voxels at which two floods meet are emptied.
    """
    bodies, sizes = _labelled(values > level)
    counted = sizes[sizes >= least]
    if len(counted) < 2:
        return values
    median, found = float(np.median(counted)), values.copy()
    levels = level + (float(values.max()) - level) * np.arange(1, LEVELS) / LEVELS
    for number in np.flatnonzero(sizes > LARGE * median) + 1:
        _part(found, bodies == number, levels, median)
    return found


def _part(values: np.ndarray, body: np.ndarray, levels: np.ndarray, median: float) -> None:
    """Empty the voxels of `values` where the pieces of one body meet."""
    from skimage.segmentation import watershed

    if body.sum() <= LARGE * median:
        return
    for k, level in enumerate(levels):
        pieces, sizes = _labelled(body & (values > level))
        own = np.flatnonzero(sizes >= PIECE * median) + 1
        if not len(own):
            return
        if len(own) > 1:
            flooded = watershed(-values, np.where(np.isin(pieces, own), pieces, 0), mask=body, watershed_line=True)
            values[body & (flooded == 0)] = 0
            for piece in own:
                _part(values, flooded == piece, levels[k + 1 :], median)
            return


def _labelled(mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Numbers [Z, Y, X] of what hangs together, from 1 on, and how many voxels each has."""
    found = np.empty(mask.shape, dtype=np.int32)
    count = int(ndimage.label(mask, output=found))  # pyright: ignore[reportArgumentType] (a number where output is given)
    return found, np.bincount(found.ravel(), minlength=count + 1)[1:]


def moments(mesh: TriangleMesh) -> tuple[float, np.ndarray, np.ndarray]:
    """Volume [m³], centre [3] [m], and second moments about it [3, 3] [m⁵] of what a closed mesh encloses.

    Sums over tetrahedra from a point inside to the triangles, each exact: ∫ x xᵀ = V/20 (Σ pᵢ pᵢᵀ + s sᵀ), s = Σ pᵢ.
    """
    origin = mesh.vertices.mean(0)
    corners = (mesh.vertices - origin)[mesh.faces]
    a, b, c = np.moveaxis(corners, 1, 0)
    parts = np.einsum("fi,fi->f", a, np.cross(b, c)) / 6
    total, sums = corners.sum(1), parts.sum()
    middle = (parts[:, None] * total / 4).sum(0) / sums
    second = np.einsum("f,fci,fcj->ij", parts, corners, corners) + np.einsum("f,fi,fj->ij", parts, total, total)
    return float(sums), origin + middle, second / 20 - sums * np.outer(middle, middle)


def centroid(mesh: TriangleMesh) -> np.ndarray:
    """Centre of mass `(x, y, z)` [m] of what a closed mesh encloses."""
    origin = mesh.vertices.mean(0)
    a, b, c = np.moveaxis((mesh.vertices - origin)[mesh.faces], 1, 0)
    parts = np.einsum("fi,fi->f", a, np.cross(b, c)) / 6
    return origin + (parts[:, None] * (a + b + c) / 4).sum(0) / parts.sum()


def second_moments(mesh: TriangleMesh) -> np.ndarray:
    """[3, 3] of what a closed mesh encloses about its middle, over its volume, in the square of the unit of its
    vertices."""
    volume, _, second = moments(mesh)
    return second / volume


def stretched_like(mesh: TriangleMesh, rest: TriangleMesh) -> np.ndarray:
    """Matrix [3, 3] of determinant one by which the ellipsoid of second moments of `rest` becomes one like `mesh`'s."""
    (values, axes), (rests, frame) = (np.linalg.eigh(moments(one)[2]) for one in (mesh, rest))
    axes = axes * np.sign(np.linalg.det(axes) * np.linalg.det(frame)) ** np.array([1, 0, 0])
    stretch = np.sqrt(np.maximum(values, 0) / rests)
    return (axes * (stretch / stretch.prod() ** (1 / 3))) @ frame.T
