"""Matter on voxels, as an Object: what the classical methods give, and what can be fitted to frames."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping
from typing import Any, ClassVar

from torch import Tensor

from ..backends import device
from ..checks import require
from ..display import of_object
from ..geometry import Grid, Poses, Views
from ..matter import Matter
from ..volume import LineIntegrals, Volume
from .voxel_lines import VoxelLines, along_axes, axis_matrices

MOST_PROJECTORS = 16
"""Projectors that a grid keeps ready, one for each batch of views: as many as a fit of single views has at most."""


class VoxelGrid:
    """Values on a grid: occupancies of known materials, or δ and β apart. Outside the grid there is nothing.

    values: [C, Z, Y, X] float32, of the channels of `matter`. Errors: `InputError` if the shapes do not fit.
    """

    kind: ClassVar[str] = "voxels"
    """The name of this kind of Object in files."""
    _repr_html_ = of_object

    def __init__(self, values: Tensor, grid: Grid, matter: Matter) -> None:
        shape, wanted = tuple(values.shape), (len(matter), *grid.shape)
        require(shape == wanted, f"voxel values must have the shape {wanted}, but they have {shape}.")
        self.values, self.grid, self.matter = values, grid, matter
        self.backend = "cpu"
        self._projectors: OrderedDict[bytes, VoxelLines] = OrderedDict()

    def parameters(self) -> dict[str, Tensor]:
        """The trainable tensor, by name."""
        return {"values": self.values}

    def with_parameters(self, parameters: Mapping[str, Tensor]) -> VoxelGrid:
        """The same grid with other values; projectors that are ready stay so."""
        grid = VoxelGrid(parameters.get("values", self.values), self.grid, self.matter)
        grid._projectors, grid.backend = self._projectors, self.backend
        return grid

    def state(self) -> dict[str, Any]:
        """Tensors and plain values that `from_state` makes the same grid of."""
        lengths = {"voxel_size": list(self.grid.voxel_size), "origin": list(self.grid.origin)}
        return {"values": self.values, **lengths, "matter": self.matter.as_dict()}

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> VoxelGrid:
        """The grid that `state` described."""
        size, origin = (tuple(float(v) for v in state[name]) for name in ("voxel_size", "origin"))
        values = state["values"]
        return cls(values, Grid(tuple(values.shape[1:]), size, origin), Matter.from_dict(state["matter"]))  # type: ignore[arg-type]

    @property
    def described(self) -> str:
        """How large the grid is, in words."""
        return " × ".join(map(str, self.grid.shape)) + " voxels"

    @property
    def stored_bytes(self) -> int:
        """Size of the values as float16."""
        return 2 * self.values.numel()

    def on(self, backend: str) -> VoxelGrid:
        """The grid for another backend (resolved), on that backend's device; itself where it is that already."""
        if backend == self.backend:
            return self
        grid = VoxelGrid(self.values.to(device(backend)), self.grid, self.matter)
        grid.backend = backend
        return grid

    def enclosing_grid(self, most_voxels: int) -> Grid:
        """The grid itself, whatever its size."""
        return self.grid

    def at(self, time: float) -> VoxelGrid:
        """The grid itself: it does not move."""
        return self

    def project(self, views: Views | Poses) -> LineIntegrals:
        """Line integrals (B, D), differentiable in the values and in unknown poses (see `VoxelLines`)."""
        return LineIntegrals(self._lines(views)(self.values), self.matter.channels)

    def _lines(self, views: Views | Poses) -> VoxelLines:
        """The projector of `views`: made once, or anew where the poses are unknown and move."""
        if isinstance(views, Poses) and views.requires_grad:
            return VoxelLines(self.grid, views, self.backend)
        seen = views if isinstance(views, Views) else views.views()
        key = seen.fingerprint()
        if key not in self._projectors:
            self._projectors[key] = VoxelLines(self.grid, seen, self.backend)
            while len(self._projectors) > MOST_PROJECTORS:
                self._projectors.popitem(last=False)
        return self._projectors[key]

    def voxelise(self, grid: Grid) -> Volume:
        """δ and β on `grid`: the values themselves if it is this one, else as `resampled` has them."""
        return self.matter.volume(self.resampled(grid).values.detach().cpu().numpy(), grid)

    def resampled(self, grid: Grid) -> VoxelGrid:
        """The same matter on `grid`: means over larger voxels, linear between centres on finer ones."""
        if grid == self.grid:
            return self
        return VoxelGrid(along_axes(self.values, axis_matrices(self.grid, grid)), grid, self.matter)

    def freed(self) -> VoxelGrid:
        """The same matter with δ and β free: a single occupancy in both channels."""
        return VoxelGrid(self.values[:1].repeat(2, 1, 1, 1), self.grid, self.matter.freed())
