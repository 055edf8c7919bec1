"""Surfaces out of volumes: marching cubes, removal of small shells, smoothing; subdivision of triangles."""

from __future__ import annotations

import numpy as np
import torch
from scipy.sparse import coo_array, csr_array, diags_array
from torch import Tensor

from ..checks import InputError, require, shaped
from ..geometry import Grid
from ..mesh import TriangleMesh, shell_labels

SHRINK, SWELL = 0.5, -0.53
"""Taubin's two factors, which together smooth and keep the volume (1995, "A signal processing approach to fair surface
design")."""


def isosurface(
    values: np.ndarray, grid: Grid, level: float = 0.5, least_volume: float = 8.0, smoothing: int = 10
) -> TriangleMesh:
    """The closed surface [m] where `values` [Z, Y, X] on `grid` cross `level`, wound outwards from larger values.

    Marching cubes (Lorensen & Cline 1987, as VTK's flying edges of Schroeder et al. 2015 does them), with nothing
    around the grid. Shells of fewer than `least_volume` voxels, bodies or cavities, are left out; `smoothing`: steps
    of Taubin's filter. Errors: `InputError` if shapes differ, or nothing is left.
    """
    shaped("values", values, grid.shape)
    require(least_volume >= 0, f"least_volume must not be negative, but it is {least_volume:g}.")
    points, faces = _marching_cubes(values, level)
    if len(faces):
        faces = _large_shells(points, faces, least_volume)
    if not len(faces):
        raise InputError(
            f"no body of {least_volume:g} voxels or more reaches the level {level:g} (the largest value is "
            f"{float(values.max()):.3g}), so there is no surface; lower the level."
        )
    used, index = np.unique(faces, return_inverse=True)
    points, faces = points[used], index.reshape(-1, 3)
    mean = neighbour_mean(faces, len(points))
    for _ in range(smoothing):
        for factor in (SHRINK, SWELL):
            points = points + factor * (mean @ points - points)
    return TriangleMesh(points * np.array(grid.voxel_size) + np.array(grid.origin), faces, "isosurface")


def neighbour_mean(faces: np.ndarray, vertex_count: int) -> csr_array:
    """[P, P] sparse: takes values of vertices to the means over their neighbours."""
    edges = adjacency(faces, vertex_count)
    return csr_array(diags_array(1 / np.maximum(edges.sum(1), 1)) @ edges)


def adjacency(faces: np.ndarray, vertex_count: int) -> csr_array:
    """[P, P] sparse, symmetric: 1 for two vertices of one edge."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    both = np.concatenate([edges, edges[:, ::-1]])
    found = csr_array(coo_array((np.ones(len(both)), tuple(both.T)), shape=(vertex_count,) * 2))
    found.data[:] = 1  # each edge was counted once a triangle
    return found


def _marching_cubes(values: np.ndarray, level: float) -> tuple[np.ndarray, np.ndarray]:
    """Points [P, 3] `(x, y, z)` in voxels, faces [F, 3]; nothing lies around the volume."""
    from vtkmodules.util.numpy_support import numpy_to_vtk, vtk_to_numpy
    from vtkmodules.vtkCommonDataModel import vtkImageData
    from vtkmodules.vtkFiltersCore import vtkFlyingEdges3D

    padded = np.pad(np.asarray(values, dtype=np.float32), 1)
    image = vtkImageData()
    image.SetDimensions(*padded.shape[::-1])
    image.SetOrigin(-1, -1, -1)
    image.GetPointData().SetScalars(numpy_to_vtk(padded.ravel(), deep=True))
    cubes = vtkFlyingEdges3D()
    cubes.SetInputData(image)
    cubes.SetValue(0, level)
    for switch in (cubes.ComputeNormalsOff, cubes.ComputeGradientsOff, cubes.ComputeScalarsOff):
        switch()
    cubes.Update()
    found = cubes.GetOutput()
    if found.GetNumberOfCells() == 0:
        return np.empty((0, 3)), np.empty((0, 3), dtype=np.int64)
    points = vtk_to_numpy(found.GetPoints().GetData()).astype(np.float64)
    faces = vtk_to_numpy(found.GetPolys().GetConnectivityArray()).reshape(-1, 3)
    return points, faces.astype(np.int64)


def _large_shells(points: np.ndarray, faces: np.ndarray, least: float) -> np.ndarray:
    """The faces of shells that enclose at least `least`, in the points' units."""
    labels = shell_labels(faces, len(points))
    a, b, c = np.moveaxis(points[faces], 1, 0)
    volumes = np.bincount(labels, np.einsum("fi,fi->f", a, np.cross(b, c)) / 6)
    return faces[np.abs(volumes[labels]) >= max(least, 1e-6)]


def edge_lengths(vertices: Tensor, faces: Tensor) -> Tensor:
    """Lengths [3 F] of the triangles' edges, in the unit of `vertices` [P, 3]; faces [F, 3]."""
    corners = vertices[faces]
    return (corners - corners.roll(1, dims=1)).norm(dim=2).flatten()


def loop_subdivision(vertices: Tensor, faces: Tensor) -> tuple[Tensor, Tensor]:
    """Vertices [P + E, 3] and faces [4 F, 3]: each triangle of closed surfaces is four (C. Loop 1987, "Smooth
    subdivision surfaces based on triangles", section 3), wound as before.

    New vertices lie at 3/8 of both ends of their edge and 1/8 of both corners across it; old ones move to
    `(1 - nβ) v + β Σ neighbours`, `β = (5/8 - (3/8 + cos(2π/n)/4)²)/n`. So facets become a smooth surface; a sphere of
    triangles shrinks a little, which a fit gives back.
    """
    points, triangles = vertices.detach().double().numpy(), faces.numpy()
    edges, edge_of = _edges(triangles)
    count = len(points)
    ends = points[edges].sum(axis=1)
    across = _summed(edge_of.ravel(), points[triangles[:, [2, 0, 1]].ravel()], len(edges))
    middles = 0.375 * ends + 0.125 * across
    degree = np.bincount(edges.ravel(), minlength=count)
    neighbours = _summed(edges.ravel(), points[edges[:, ::-1].ravel()], count)
    n = np.maximum(degree, 3)
    beta = ((0.625 - (0.375 + 0.25 * np.cos(2 * np.pi / n)) ** 2) / n)[:, None]
    old = (1 - degree[:, None] * beta) * points + beta * neighbours
    ab, bc, ca = (edge_of[:, k] + count for k in range(3))
    a, b, c = triangles.T
    finer = np.stack([a, ab, ca, b, bc, ab, c, ca, bc, ab, bc, ca], axis=1).reshape(-1, 3)
    return torch.from_numpy(np.concatenate([old, middles])).to(vertices), torch.from_numpy(finer).to(faces)


def _edges(triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Edges [E, 2], each once, and the number of the edges AB, BC, CA of each triangle [F, 3]."""
    sides = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]], axis=2).reshape(-1, 2).astype(np.int64)
    keys, index = np.unique(sides[:, 0] * (int(triangles.max()) + 1) + sides[:, 1], return_inverse=True)
    first = int(triangles.max()) + 1
    return np.stack([keys // first, keys % first], axis=1), index.reshape(-1, 3)


def _summed(index: np.ndarray, values: np.ndarray, count: int) -> np.ndarray:
    """Sums [count, 3] of `values` [N, 3] by their `index` [N]."""
    select = coo_array((np.ones(len(index)), (index, np.arange(len(index)))), shape=(count, len(index)))
    return np.asarray(select.tocsr() @ values)
