"""Voxel grids, views and random values."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.nn.functional import avg_pool3d, pad

from holosplat.geometry import Grid, Poses, Views
from holosplat.projectors.voxels.lattice import lattice_reference
from holosplat.representations.voxels import along_axes, axis_matrices
from holosplat_bench.opponents.fields import NeuralField

DOUBLE = torch.float64
ROWS = Grid((11, 7, 9), (1.1, 1.0, 0.9), (-4.0, -3.0, -3.7))
"""Rows along y are those of a detector of 7 rows of pitch 1."""


def around(count: int, shape: tuple[int, int], shift: float = 0.0) -> Views:
    """Views about y at odd angles and both axes' own, with a detector shift of their own along x."""
    angles = np.concatenate([[0.0, 90.0], np.linspace(13, 167, count)])[:count]
    shifts = np.stack([shift * np.arange(count), np.zeros(count)], 1)
    return replace(Views.from_angles(angles, shape, 1.0), shifts=shifts)


def anyhow(count: int, shape: tuple[int, int], seed: int = 0) -> Views:
    """Views from all directions, with shifts along both axes."""
    shifts = np.random.default_rng(seed).uniform(-1, 1, (count, 2))
    return Views(Rotation.random(count, rng=seed).as_matrix(), shifts, shape, 1.0)


def randoms(*shape: int, seed: int = 0, dtype: torch.dtype = DOUBLE) -> Tensor:
    """Normal random numbers."""
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def pronounced(field: NeuralField) -> NeuralField:
    """The field in float64, with an encoding that tells places apart."""
    field = field.to(dtype=DOUBLE)
    encoding = {name: 3e3 * p for name, p in field.parameters().items() if name.startswith("encoding.")}
    return field.with_parameters(encoding)


def twin(values: Tensor, grid: Grid, poses: Poses, factors: tuple[int, int, int]) -> Tensor:
    """Line integrals [V, C, H, W] of values [C, Z, Y, X] in plain torch, any float type."""
    fine = grid.divided(factors)
    (nz, ny, nx), (x, y, z) = fine.shape, (o - 0.5 * d for o, d in zip(fine.origin, fine.voxel_size))
    between = Grid((nz + 1, ny + 1, nx + 1), fine.voxel_size, (x, y, z))
    values = along_axes(values, axis_matrices(grid, fine))
    corners = avg_pool3d(pad(values, (1, 1, 1, 1, 1, 1)), 2, stride=1)
    pairs = [(lattice_reference(a, fine, poses), lattice_reference(b, between, poses)) for a, b in zip(values, corners)]
    return torch.stack([0.5 * (a + b) for a, b in pairs], dim=1)
