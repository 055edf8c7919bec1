"""Ray casting through a voxel grid: a Riemann sum of trilinear samples along parallel rays or cones, in plain torch."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, grid_sample

from ...checks import require
from ...geometry import Grid, Views


def voxel_line_integrals(values: Tensor, grid: Grid, views: Views, *, step: float = 0.5, rays: int = 1) -> Tensor:
    """Line integrals [V, C, H, W] in metres × value of `values` [C, Z, Y, X] on `grid`; differentiable in `values`.

    step: sampling distance along the ray, in units of the smallest voxel edge; rays: `rays × rays` rays a pixel
    are averaged. Outside the grid the values are zero.
    """
    require(values.ndim == 4 and tuple(values.shape[1:]) == grid.shape, "values must have the shape (C, Z, Y, X).")
    require(step > 0 and rays >= 1, f"step must be positive and rays at least 1, but they are {step} and {rays}.")
    fine = views.refined(rays)
    return torch.stack([avg_pool2d(_cast(values, grid, fine, v, step), rays) for v in range(len(views))])


def _cast(values: Tensor, grid: Grid, views: Views, v: int, step: float) -> Tensor:
    """[C, H, W]: the sum over depth of samples on a lab-frame lattice, times the step length [m]."""
    h, w = views.shape
    size = np.array(grid.voxel_size)
    centre = np.array(grid.origin) + 0.5 * (np.array(grid.shape[::-1]) - 1) * size
    half = 0.5 * np.array(grid.shape[::-1]) * size
    length = step * float(size.min())
    rotation, shift = views.rotations[v], views.shifts[v]
    reach = float(np.abs(rotation[2]) @ (half + 0.5 * size))  # samples fade half a voxel beyond the grid
    pixel = float(views.pixel_sizes[v])
    x = (np.arange(w) + 0.5 - w / 2) * pixel + shift[0]
    y = (np.arange(h) + 0.5 - h / 2) * pixel + shift[1]
    count = 2 * int(np.ceil(reach / length)) + 1
    z = (np.arange(count) - count // 2) * length + float((rotation @ centre)[2])
    # x_obj = Rᵀ x_lab is affine in (x, y, z): normalised to [-1, 1] for grid_sample, one row of pixels at a time.
    to_unit = (rotation / half).astype(np.float64)
    # In a cone, x and y grow with the distance from the source, and steps along the beam are longer beside its axis.
    bent = 0.0 if views.sources is None else 1 / float(views.sources[v])
    grown = 1 + bent * z[:, None, None]
    base = torch.as_tensor(grown * x[None, :, None] * to_unit[0] + z[:, None, None] * to_unit[2] - centre / half)
    rows = torch.as_tensor(grown[..., None] * (y[:, None] * to_unit[1])[None, :, None])
    oblique = torch.as_tensor(np.sqrt(1 + bent**2 * (x**2 + y[:, None] ** 2))).to(values)
    chunk = max(1, 4_000_000 // (count * w))
    parts = []
    for start in range(0, h, chunk):
        points = base[:, None] + rows[:, start : start + chunk]
        sampled = grid_sample(values[None], points[None].to(values.dtype), align_corners=False)
        parts.append(sampled[0].sum(dim=1))
    return torch.cat(parts, dim=1) * length * oblique
