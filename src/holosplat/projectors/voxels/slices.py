"""Sparse slice matrices: with one rotation axis, all slices share one matrix (exact strip integrals of voxels)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property, lru_cache

import numpy as np
import torch
from scipy.sparse import csr_array
from torch import Tensor

from ...backends import device, implementation
from ...checks import require
from ...geometry import Grid, Views

Entries = tuple[Tensor, Tensor, Tensor]
"""Of a CSR matrix: starts of its rows (int64), columns in ascending order (int64), values (float32)."""

BLOCK = 1 << 19
"""Entries that are made at once, at most."""
SMALL = 1 << 16
"""Voxels of a slice times views, at most, of matrices that are kept: a few MB each."""
KEPT = 16
"""Small matrices that are kept: a run asks for the same ones for its start, its cross-validation and its verdict."""


class SliceProjector:
    """Parallel-beam projector for views that share the y axis; forward and exact adjoint, float32.

    Backends: `cpu` (C++), `cuda` (Triton) and `reference` (torch's sparse products). Arrays are given and made where
    the backend computes.

    Its arrays are ordered for speed: volumes [Z, X, Y] and line integrals [V, W, H], so that all slices are the
    columns of one product with a sparse matrix; `volume_in`, `volume_out` and `lines_in`, `lines_out` convert.
    The grid's rows along y must be the detector's rows. A voxel's shadow across the axis is the exact trapezoid
    of a rotated square, integrated over each pixel (Kak & Slaney 1988, section 7.1, strip model).
    """

    def __init__(self, grid: Grid, views: Views, backend: str = "cpu") -> None:
        require(views.shares_axis, "slice matrices need views that turn about the y axis only.")
        require(rows_match(grid, views), "slice matrices need voxel rows that are the detector's rows.")
        self.grid, self.views, self.backend = grid, views, backend
        nz, ny, nx = grid.shape
        self.array_shape = (nz, nx, ny)
        self._rays = (len(views), views.shape[1])
        make = _kept if nz * nx * len(views) <= SMALL else _Matrix
        matrix, there = make(_Asked(grid, views.fingerprint(), views)), device(backend)

        def entries(transposed: bool) -> Entries:
            starts, columns, values = matrix.transposed if transposed else matrix.plain
            return starts.to(there), columns.to(there), values.to(there)

        products = implementation(f"{__package__}.slice_products", backend).Products
        self._products = products(entries, (math.prod(self._rays), nz * nx))

    def project(self, array: Tensor) -> Tensor:
        """Line integrals [V, W, H] in metres × value of a volume in the order [Z, X, Y]."""
        lines: Tensor = self._products.project(array.reshape(-1, array.shape[2]))
        return lines.reshape(*self._rays, -1)

    def backproject(self, lines: Tensor) -> Tensor:
        """The adjoint of `project`: [V, W, H] → [Z, X, Y]."""
        volume: Tensor = self._products.backproject(lines.reshape(-1, lines.shape[2]))
        return volume.reshape(*self.array_shape[:2], -1)

    def volume_in(self, volume: Tensor) -> Tensor:
        """[Z, Y, X] → [Z, X, Y]."""
        return volume.transpose(1, 2).contiguous()

    volume_out = volume_in

    def lines_in(self, images: Tensor) -> Tensor:
        """[V, H, W] → [V, W, H]."""
        return images.transpose(1, 2).contiguous()

    lines_out = lines_in


@dataclass(frozen=True)
class _Asked:
    """Grid and views of a projector; equal to those of the same views."""

    grid: Grid
    mark: bytes
    views: Views = field(compare=False)


class _Matrix:
    """The slice matrix [V·W, Z·X] of a grid and views, and its transpose; nobody writes to their entries."""

    def __init__(self, asked: _Asked) -> None:
        self._shadows = voxel_shadows(asked.grid, asked.views)

    @cached_property
    def transposed(self) -> Entries:
        """The entries of the transpose."""
        return _entries(self._shadows)

    @cached_property
    def plain(self) -> Entries:
        """The entries of the matrix."""
        return _entries(self._shadows.T.tocsr())


_kept = lru_cache(maxsize=KEPT)(_Matrix)


def _entries(matrix: csr_array) -> Entries:
    starts, columns = (
        torch.from_numpy(array.astype(np.int64, copy=False)) for array in (matrix.indptr, matrix.indices)
    )
    return starts, columns, torch.from_numpy(matrix.data)


def rows_match(grid: Grid, views: Views) -> bool:
    """Whether the grid's rows along y are the detector's rows."""
    edge = grid.origin[1] - 0.5 * grid.voxel_size[1] - float(views.shifts[0, 1])
    off = max(abs(edge + 0.5 * views.height), abs(grid.voxel_size[1] - views.pixel_size))
    return grid.shape[1] == views.shape[0] and off < 1e-6 * views.pixel_size


def voxel_shadows(grid: Grid, views: Views) -> csr_array:
    """Transposed slice matrix [Z·X, V·W], CSR, float32: mean over each pixel of the path length [m] through each voxel.

    Views follow one another within each voxel's row, so that nothing has to be sorted.
    """
    x, _, z = grid.axes()
    dx, _, dz = grid.voxel_size
    (w, p), count = (views.shape[1], views.pixel_size), len(views)
    cosines, sines = views.rotations[:, 0, 0] / p, views.rotations[:, 0, 2] / p
    sides = np.sort(np.abs([cosines * dx, sines * dz]), axis=0)
    most = int(np.ceil(sides.sum(axis=0)).max()) + 1
    steps, numbers = np.arange(most + 1), list[np.ndarray]()
    columns, data = list[np.ndarray](), list[np.ndarray]()
    for part in np.array_split(z, min(len(z), math.ceil(len(z) * len(x) * count * most / BLOCK))):
        shares = np.empty((len(part) * len(x), count, most), dtype=np.float32)
        first = np.empty(shares.shape[:2], dtype=np.int64)
        for v, (narrow, wide) in enumerate(sides.T):
            centres = (cosines[v] * x + sines[v] * part[:, None]).ravel() + 0.5 * w - views.shifts[v, 0] / p
            first[:, v] = np.floor(centres - 0.5 * (wide + narrow))
            within = _trapezoid_integral(first[:, v] + steps[:, None] - centres, wide, narrow)
            shares[:, v] = np.diff(within, axis=0).T
        pixels = first[..., None] + steps[:-1]
        seen = (shares > 1e-12) & (pixels >= 0) & (pixels < w)
        pixels += w * np.arange(count)[:, None]
        numbers.append(np.count_nonzero(seen, axis=(1, 2)))
        columns.append(pixels[seen])
        data.append(shares[seen] * np.float32(dx * dz / p))
    starts = np.concatenate([[0], np.cumsum(np.concatenate(numbers))])
    shape = (len(z) * len(x), count * w)
    return csr_array((np.concatenate(data), np.concatenate(columns), starts), shape=shape)


def _trapezoid_integral(t: np.ndarray, wide: float, narrow: float) -> np.ndarray:
    """∫_{-∞}^t of the unit-area trapezoid box(wide) * box(narrow); t is overwritten."""
    if narrow < 1e-9 * wide:
        return np.clip(t / wide + 0.5, 0, 1)
    a, b = 0.5 * (wide + narrow), 0.5 * (wide - narrow)
    inside: np.ndarray = np.square(np.clip(t, -a, a, out=t) + a)
    for corner in (b, -b):
        past = np.maximum(t + corner, 0)
        inside -= np.square(past, out=past)
    inside /= 2 * wide * narrow
    return inside
