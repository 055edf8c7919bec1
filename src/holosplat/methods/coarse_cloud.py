"""Gaussians that fill closed surfaces: where large frames start, if Gaussians are wanted."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from ..checks import require
from ..geometry import Grid
from ..mesh import shell_labels
from ..projectors.surface import surface_occupancy
from ..representations import GaussianCloud, SurfaceMesh
from ..representations.initialise import cloud_of_moments, moments
from .method import Task

MOST_VOXELS = 1 << 24
"""Half cells that are looked at together: an array of them is 134 MB."""
MOST_GAUSSIANS = 3_000_000
"""Gaussians at most; beyond, all are twice as large."""
FILLED = 0.02
"""Share of matter from which on a cell becomes a Gaussian."""

Moments = tuple[Tensor, Tensor, Tensor]
"""Mass, centre and covariance of the matter in each cell."""


def cloud_of_surfaces(mesh: SurfaceMesh, task: Task) -> GaussianCloud:
    """Gaussians of the matter in `mesh`, one a cell of a pixel of the frames of `task`. Errors: `InputError` where
    there is none."""
    grid, edge = Grid.of_views(task.scan.views), 1
    while True:
        cell = edge * grid.voxel_size[0]
        found = matter_in_cells(mesh, cell, grid.origin)
        if len(found[0]) <= MOST_GAUSSIANS:
            break
        edge *= 2
    mass, centre, covariance = found
    require(len(mass) > 0, "there is no matter in the surfaces to make Gaussians of.")
    centre = centre + torch.tensor(grid.origin, dtype=torch.float64) / cell
    return cloud_of_moments(mass, centre, covariance, cell, mesh.unit_length, mesh.matter)


def matter_in_cells(mesh: SurfaceMesh, cell: float, origin: tuple[float, float, float]) -> Moments:
    """Moments of the matter in cells of an edge `cell` [m], of which one has its centre at `origin` [m]; in cells from
    there."""
    vertices = mesh.vertices.detach()
    points = (vertices * mesh.unit_length - torch.tensor(origin).to(vertices)) / cell
    parts = [part for first, stop, faces in regions(points, mesh.faces) for part in _cells(points, faces, first, stop)]
    mass, centre, covariance = (torch.cat(values).cpu() for values in zip(*parts))
    return mass, centre, covariance


def regions(points: Tensor, faces: Tensor) -> list[tuple[np.ndarray, np.ndarray, Tensor]]:
    """First cell and stop [3] `(x, y, z)` of boxes that do not overlap, and the faces of the shells in each.

    points: in cells. Shells whose boxes overlap share one: the inner wall of a hollow body alone is no body.
    """
    label = shell_labels(faces.cpu().numpy(), len(points))
    corners = points[faces].cpu().numpy()
    count = int(label.max()) + 1
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    np.minimum.at(low, label, corners.min(axis=1))
    np.maximum.at(high, label, corners.max(axis=1))
    first, stop = np.floor(low + 0.5).astype(int), np.floor(high + 0.5).astype(int) + 1
    while True:
        overlap = (first[:, None] < stop[None]).all(axis=2)
        number, group = connected_components(overlap & overlap.T, directed=False)
        if number == len(first):
            break
        label = group[label]
        first = np.array([first[group == k].min(axis=0) for k in range(number)])
        stop = np.array([stop[group == k].max(axis=0) for k in range(number)])
    shells = torch.from_numpy(label).to(faces.device)
    return [(first[k], stop[k], faces[shells == k]) for k in range(len(first))]


def _cells(points: Tensor, faces: Tensor, first: np.ndarray, stop: np.ndarray) -> Iterator[Moments]:
    """The moments of the cells of a box, some rows at a time; only triangles that reach into them are looked at."""
    width, depth = int(stop[0] - first[0]), int(stop[2] - first[2])
    rows = max(1, MOST_VOXELS // (8 * depth * width))
    y = points[:, 1][faces]
    low, high = y.amin(dim=1), y.amax(dim=1)
    for top in range(int(first[1]), int(stop[1]), rows):
        count = min(rows, int(stop[1]) - top)
        corner = torch.tensor([first[0], top, first[2]]).to(points)
        here = faces[(high >= top - 0.75) & (low <= top + count - 0.25)]
        if len(here):
            inside = surface_occupancy(2 * (points - corner) + 0.5, here, (2 * depth, 2 * count, 2 * width), lines=2)
            mass, centre, covariance = moments(inside, FILLED)
            yield mass, centre + corner, covariance
