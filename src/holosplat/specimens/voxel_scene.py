"""A volume as a specimen: δ and β between voxel centres by trilinear interpolation, projected by casting rays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch.nn.functional import grid_sample

from ..checks import require
from ..geometry import Grid, Views
from ..projectors.voxels.raycast import voxel_line_integrals
from ..volume import LineIntegrals, Volume

STEP = 0.25
"""Distance of samples along a ray, in voxels: line integrals are then right to 1e-3 of the thickest."""
MOST_POINTS = 1 << 22
"""Points that are evaluated at once."""


@dataclass(frozen=True, eq=False)
class VoxelScene:
    """The truth that a volume describes: its values stand at the centres of voxels, and are interpolated in between.

    No fit projects so: fits use slice matrices and the lattice of voxels. `InputError` for a volume without matter.
    """

    volume: Volume

    def __post_init__(self) -> None:
        empty = not (self.volume.delta.any() or self.volume.beta.any())
        require(not empty, "a volume must hold matter, but its δ and β are zero everywhere.")

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner `(x, y, z)` [m] of the voxels that are not empty."""
        filled = (self.volume.delta != 0) | (self.volume.beta != 0)
        low, high = [], []
        for axis, at, size in zip((2, 1, 0), self.volume.grid.axes(), self.volume.grid.voxel_size):
            there = np.flatnonzero(filled.any(tuple(a for a in range(3) if a != axis)))
            low.append(at[there[0]] - 0.5 * size)
            high.append(at[there[-1]] + 0.5 * size)
        return np.array(low), np.array(high)

    def at(self, time: float) -> VoxelScene:
        """The scene itself: it does not move."""
        return self

    def missing_field(self, views: Views) -> float:
        """How far [m] the filled box reaches beyond the detector in the worst view (0 or less: it fits)."""
        lab = _corners(self.bounds, views)
        return float((np.abs(lab) - 0.5 * views.fields[:, None]).max())

    def project(self, views: Views) -> LineIntegrals:
        """Line integrals of δ and β, [V, 2, H, W]: one channel where β is δ times a number.

        Rays are cast where the filled box is, with a margin of a voxel, and no others.
        """
        values, kinds = self._channels()
        counts = np.array(views.shape[::-1])
        lines = torch.zeros((len(views), len(kinds), *views.shape))
        margin = max(self.volume.grid.voxel_size)
        for v, (lab, p) in enumerate(zip(_corners(self.bounds, views), views.pixel_sizes)):
            first = np.clip(np.floor((lab.min(0) - margin) / p + 0.5 * counts), 0, counts).astype(int)
            last = np.clip(np.ceil((lab.max(0) + margin) / p + 0.5 * counts), 0, counts).astype(int)
            if np.any(last <= first):
                continue
            shift = views.shifts[v] + (0.5 * (first + last) - 0.5 * counts) * p
            (w, h), (column, row) = last - first, first
            part = Views(views.rotations[[v]], shift[None], (h, w), float(p))
            cast = voxel_line_integrals(values, self.volume.grid, part, step=STEP)
            lines[v, :, row : row + h, column : column + w] = cast[0]
        return LineIntegrals(lines, kinds)

    def voxelise(self, grid: Grid) -> Volume:
        """δ and β averaged over the voxels of `grid`: the mean of two points or more a voxel of the volume and edge."""
        own = self.volume.grid
        n = max(2, *(2 * int(np.ceil(d / o)) for d, o in zip(grid.voxel_size, own.voxel_size)))
        inside = (np.arange(n) + 0.5) / n - 0.5
        values = torch.from_numpy(np.stack([self.volume.delta, self.volume.beta]))[None]
        x, y, z = (
            2 * ((at[:, None] + d * inside).reshape(-1) - centre) / (size * count)
            for at, d, centre, size, count in zip(
                grid.axes(), grid.voxel_size, own.centre, own.voxel_size, own.shape[::-1]
            )
        )
        out = np.zeros((2, *grid.shape), np.float32)
        step = max(1, MOST_POINTS // (n * len(x) * len(y)))
        for start in range(0, grid.shape[0], step):
            stop = min(start + step, grid.shape[0])
            axes = [torch.from_numpy(a).float() for a in (z[n * start : n * stop], y, x)]
            mesh = torch.stack(torch.meshgrid(*axes, indexing="ij")[::-1], -1)
            found = grid_sample(values, mesh[None], align_corners=False)[0].numpy()
            out[:, start:stop] = found.reshape(2, stop - start, n, len(y) // n, n, len(x) // n, n).mean((2, 4, 6))
        return Volume(out[0], out[1], grid)

    def _channels(self) -> tuple[torch.Tensor, tuple[tuple[float, float], ...]]:
        """δ in units of its largest, [1, Z, Y, X], if β follows it, else δ and β, [2, Z, Y, X]; and what they are."""
        delta, beta = self.volume.delta, self.volume.beta
        scale = float(np.abs(delta).max())
        if scale > 0:
            factor = float(np.sum(beta * delta, dtype=np.float64) / np.sum(np.square(delta), dtype=np.float64))
            if np.abs(beta - factor * delta).max() <= 1e-6 * max(float(np.abs(beta).max()), 1e-30):
                return torch.from_numpy(delta / np.float32(scale))[None], ((scale, factor * scale),)
        scales = [float(np.abs(a).max()) or 1.0 for a in (delta, beta)]
        values = np.stack([a / np.float32(s) for a, s in zip((delta, beta), scales)])
        return torch.from_numpy(values), ((scales[0], 0.0), (0.0, scales[1]))


def _corners(bounds: tuple[np.ndarray, np.ndarray], views: Views) -> np.ndarray:
    """The corners [V, 8, 2] of a box on each view's detector [m], from its middle."""
    corners = np.stack(np.meshgrid(*zip(*bounds), indexing="ij"), -1).reshape(-1, 3)
    return np.einsum("vij,pj->vpi", views.rotations, corners)[..., :2] - views.shifts[:, None]
