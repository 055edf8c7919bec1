"""Matter on voxels, as an Object: what the classical methods give."""

from __future__ import annotations

from torch import Tensor

from ..checks import require
from ..geometry import Grid, Poses, Views
from ..volume import LineIntegrals, Volume
from .voxel_lines import VoxelLines, along_axes, axis_matrices


class VoxelGrid:
    """Values on a grid: one occupancy of a known material, or δ and β apart. Outside the grid there is nothing.

    values: [C, Z, Y, X] float32. With C = 1 they are the density of one material, δ = v·delta and β = v·beta; with
    C = 2 they are `(δ/delta, β/beta)`.
    """

    def __init__(self, values: Tensor, grid: Grid, delta: float, beta: float) -> None:
        shape = tuple(values.shape)
        fits = len(shape) == 4 and shape[0] in (1, 2) and shape[1:] == grid.shape
        require(fits, f"voxel values must have the shape (1 or 2, {grid.shape}), but they have {shape}.")
        self.values, self.grid = values, grid
        self.delta, self.beta = float(delta), float(beta)

    @property
    def single_material(self) -> bool:
        """Whether one density carries both δ and β."""
        return self.values.shape[0] == 1

    @property
    def stored_bytes(self) -> int:
        """Size of the values as float16."""
        return 2 * self.values.numel()

    @property
    def materials(self) -> tuple[tuple[float, float], ...]:
        """(δ, β) of a value of one, for each channel."""
        return ((self.delta, self.beta),) if self.single_material else ((self.delta, 0.0), (0.0, self.beta))

    def at(self, time: float) -> VoxelGrid:
        """The grid itself: it does not move."""
        return self

    def project(self, views: Views | Poses) -> LineIntegrals:
        """Line integrals (B, D), differentiable in the values and in unknown poses (see `VoxelLines`)."""
        return LineIntegrals(VoxelLines(self.grid, views)(self.values), self.materials)

    def voxelise(self, grid: Grid) -> Volume:
        """δ and β on `grid`: the values themselves if it is this one, else as `resampled` has them."""
        found = self.resampled(grid).values.detach().cpu().numpy()
        return Volume(found[0] * self.delta, found[-1] * self.beta, grid)

    def resampled(self, grid: Grid) -> VoxelGrid:
        """The same matter on `grid`: means over larger voxels, linear between centres on finer ones."""
        if grid == self.grid:
            return self
        values = along_axes(self.values, axis_matrices(self.grid, grid))
        return VoxelGrid(values, grid, self.delta, self.beta)

    def freed(self) -> VoxelGrid:
        """The same matter with δ and β free: a single occupancy in both channels."""
        return VoxelGrid(self.values[:1].repeat(2, 1, 1, 1), self.grid, self.delta, self.beta)
