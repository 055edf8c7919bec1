"""Sparse slice matrices: with one rotation axis, all slices share one matrix (exact strip integrals of voxels)."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
import scipy.sparse
import torch
from scipy.sparse import csr_array, csr_matrix
from torch import Tensor

from ...backends import device, implementation
from ...checks import require
from ...geometry import Grid, Views


def torch_csr(matrix: csr_matrix | csr_array, dtype: torch.dtype) -> Tensor:
    """The same matrix as a CSR tensor of `dtype`, its columns sorted within each row."""
    matrix.sort_indices()
    starts, columns = (torch.from_numpy(a.astype(np.int64)) for a in (matrix.indptr, matrix.indices))
    with warnings.catch_warnings():  # torch calls its CSR support beta
        warnings.simplefilter("ignore")
        values = torch.from_numpy(matrix.data).to(dtype)
        return torch.sparse_csr_tensor(starts, columns, values, size=matrix.shape, check_invariants=True)


SMALL = 1 << 16
"""Voxels of a slice times views, at most, of matrices that are kept: about 2 MB each."""
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
        self._products = implementation(f"{__package__}.slice_products", backend).Products(
            self._entries, (math.prod(self._rays), nz * nx)
        )

    def project(self, array: Tensor) -> Tensor:
        """Line integrals [V, W, H] in metres × value of a volume in the order [Z, X, Y]."""
        lines: Tensor = self._products.project(array.reshape(-1, array.shape[2]))
        return lines.reshape(*self._rays, -1)

    def backproject(self, lines: Tensor) -> Tensor:
        """The adjoint of `project`: [V, W, H] → [Z, X, Y]."""
        volume: Tensor = self._products.backproject(lines.reshape(-1, lines.shape[2]))
        return volume.reshape(*self.array_shape[:2], -1)

    def _entries(self, transposed: bool) -> tuple[Tensor, Tensor, Tensor]:
        """Of the matrix [V·W, Z·X] or its transpose, where the backend computes: starts of rows, columns, values."""
        nz, _, nx = self.grid.shape
        made = _kept if nz * nx * len(self.views) <= SMALL else _made
        matrix = made(_Asked(self.grid, self.views.fingerprint(), transposed, self.views))
        there = device(self.backend)
        return matrix.crow_indices().to(there), matrix.col_indices().to(there), matrix.values().to(there)

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
    """Grid and views of a projector, and whether its matrix is transposed; equal to those of the same views."""

    grid: Grid
    mark: bytes
    transposed: bool
    views: Views = field(compare=False)


def _made(asked: _Asked) -> Tensor:
    """The matrix [V·W, Z·X] of a projector, or its transpose, CSR, float32; nobody writes to it."""
    matrix = slice_matrix(asked.grid, asked.views)
    return torch_csr(matrix.T.tocsr() if asked.transposed else matrix, torch.float32)


_kept = lru_cache(maxsize=KEPT)(_made)


def rows_match(grid: Grid, views: Views) -> bool:
    """Whether the grid's rows along y are the detector's rows."""
    edge = grid.origin[1] - 0.5 * grid.voxel_size[1] - float(views.shifts[0, 1])
    off = max(abs(edge + 0.5 * views.height), abs(grid.voxel_size[1] - views.pixel_size))
    return grid.shape[1] == views.shape[0] and off < 1e-6 * views.pixel_size


def slice_matrix(grid: Grid, views: Views) -> scipy.sparse.csr_matrix:
    """CSR matrix [V·W, Z·X] of strip integrals [m]: mean over a pixel of the path length through each voxel."""
    x, _, z = grid.axes()
    dx, _, dz = grid.voxel_size
    w, p = views.shape[1], views.pixel_size
    blocks = []
    for rotation, shift in zip(views.rotations, views.shifts):
        c, s = rotation[0, 0], rotation[0, 2]
        centre = (c * x[None, :] + s * z[:, None]).ravel() - shift[0]
        wide, narrow = sorted((abs(c) * dx, abs(s) * dz), reverse=True)
        first = np.floor((centre - 0.5 * (wide + narrow)) / p + 0.5 * w).astype(np.int64)
        rows, columns, data = [], [], []
        for offset in range(int(np.ceil((wide + narrow) / p)) + 1):
            pixel = first + offset
            edge = (pixel - 0.5 * w) * p - centre
            share = _trapezoid_integral(edge + p, wide, narrow) - _trapezoid_integral(edge, wide, narrow)
            keep = (share > 1e-12) & (pixel >= 0) & (pixel < w)
            rows.append(pixel[keep])
            columns.append(np.flatnonzero(keep))
            data.append(share[keep] * (dx * dz / p))
        entries = (np.concatenate(data), (np.concatenate(rows), np.concatenate(columns)))
        blocks.append(scipy.sparse.csr_matrix(entries, shape=(w, centre.size)))
    return scipy.sparse.csr_matrix(scipy.sparse.vstack(blocks))


def _trapezoid_integral(t: np.ndarray, wide: float, narrow: float) -> np.ndarray:
    """∫_{-∞}^t of the unit-area trapezoid box(wide) * box(narrow)."""
    if narrow < 1e-9 * wide:
        return np.clip(t / wide + 0.5, 0, 1)

    def ramp(u: np.ndarray) -> np.ndarray:
        return 0.5 * np.clip(u, 0, None) ** 2

    a, b = 0.5 * (wide + narrow), 0.5 * (wide - narrow)
    inside = (ramp(t + a) - ramp(t + b) - ramp(t - b) + ramp(t - a)) / (wide * narrow)
    return np.where(t >= a, 1.0, inside)
