"""Matter on voxels, as an Object, and its line integrals: results of classical methods, and parameters of fits."""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool3d, pad

from ..backends import device
from ..checks import require
from ..display import of_object
from ..geometry import Grid, Poses, Views
from ..matter import Matter
from ..optics.resampling import between
from ..projectors.voxels import LatticeProjector, RayProjector, SliceProjector
from ..volume import LineIntegrals, Unmoved, Volume

SAME = 0.9
"""Share of the pitch that pixels may have with voxels as on pixels of the pitch: views that are found to be magnified
by some per cent keep their voxels."""

Axis = tuple[int, float, float]
"""A row of cells: their count, their size [m], and the centre of the first one [m]."""


class VoxelLines:
    """Line integrals of voxels in `views`, differentiable in their values and in unknown poses; float32, where
    `backend` (resolved) computes.

    Views about the y axis: across the axis exact strip integrals over the pixels asked for (`SliceProjector`), along
    it linear between the rows of voxels. Any other poses: hats of a voxel's size (`LatticeProjector`) from the voxels
    and from the corners between them, half the mass each. That body-centred lattice halves the ripple that a simple
    one leaves on rotated rasters. Voxels larger than the pixels asked for are interpolated to their size first. Cones:
    a ray to every pixel (`RayProjector`).

    `Poses` are unknown where gradients of their rotations or shifts are asked for. They are taken as they are now: make
    new lines when they change. They always go through the lattice, be they about the y axis or not, because strip
    integrals cannot say what a turn out of the axis does; values there differ from the strips' by the ripple.
    """

    def __init__(self, grid: Grid, views: Views | Poses, backend: str = "cpu") -> None:
        self.grid = grid
        known = views.views() if isinstance(views, Poses) and not views.requires_grad else views
        if known.sources is not None:
            self._lines = RayProjector(grid, known, backend).lines
        elif isinstance(known, Views) and known.shares_axis:
            self._lines = _AboutAxis(grid, known, backend)
        else:
            self._lines = _AnyPose(grid, known, backend)

    def __call__(self, values: Tensor) -> Tensor:
        """Line integrals [V, C, H, W] in metres × value of `values` [C, Z, Y, X]."""
        shape = tuple(values.shape[1:])
        require(shape == self.grid.shape, f"values must lie on the grid {self.grid.shape}, but on {shape}.")
        return torch.stack([self._lines(channel.float()) for channel in values], dim=1)


class _AboutAxis:
    """[Z, Y, X] → [V, H, W] for views that share the y axis."""

    def __init__(self, grid: Grid, views: Views, backend: str) -> None:
        nz, ny, nx = grid.shape
        height, pitch = views.shape[0], views.pixel_size
        first = float(views.shifts[0, 1]) - 0.5 * (height - 1) * pitch
        rows = resampling((ny, grid.voxel_size[1], grid.origin[1]), (height, pitch, first))
        used = np.flatnonzero(rows.any(dim=1).numpy())
        low, high = (int(used[0]), int(used[-1]) + 1) if len(used) else (0, 1)
        self._outside = (low, height - high)
        cut = rows[low:high]
        same = cut.shape[0] == ny and torch.allclose(cut, torch.eye(ny), atol=1e-6)
        self._rows = None if same else cut.T.contiguous().to(device(backend))
        top = first + low * pitch
        (dx, _, dz), (x, _, z) = grid.voxel_size, grid.origin
        shifts = np.stack([views.shifts[:, 0], np.full(len(views), top + 0.5 * (high - low - 1) * pitch)], axis=1)
        part = Views(views.rotations, shifts, (high - low, views.shape[1]), pitch)
        self._projector = SliceProjector(Grid((nz, high - low, nx), (dx, pitch, dz), (x, top, z)), part, backend)

    def __call__(self, values: Tensor) -> Tensor:
        array = values.transpose(1, 2)
        array = array.contiguous() if self._rows is None else array @ self._rows
        lines = _Strips.apply(array, self._projector)
        assert isinstance(lines, Tensor)
        return pad(lines, self._outside).transpose(1, 2)


class _AnyPose:
    """[Z, Y, X] → [V, H, W] for poses of any kind."""

    def __init__(self, grid: Grid, views: Views | Poses, backend: str) -> None:
        edge = views.pitch if views.finest > SAME * views.pitch else views.finest
        fx, fy, fz = (max(1, math.ceil(d / edge - 1e-6)) for d in grid.voxel_size)
        fine = grid.divided((fx, fy, fz))
        self._matrices = None if fine is grid else axis_matrices(grid, fine)
        (nz, ny, nx), (x, y, z) = fine.shape, (o - 0.5 * d for o, d in zip(fine.origin, fine.voxel_size))
        between = Grid((nz + 1, ny + 1, nx + 1), fine.voxel_size, (x, y, z))
        self._projectors = (LatticeProjector(fine, views, backend), LatticeProjector(between, views, backend))

    def __call__(self, values: Tensor) -> Tensor:
        if self._matrices is not None:
            values = along_axes(values, self._matrices)
        corners = avg_pool3d(pad(values, (1, 1, 1, 1, 1, 1))[None, None], 2, stride=1)[0, 0]
        parts = [projector.lines(a) for projector, a in zip(self._projectors, (values, corners))]
        return 0.5 * (parts[0] + parts[1])


def axis_matrices(grid: Grid, target: Grid) -> tuple[Tensor, Tensor, Tensor]:
    """The matrices of `resampling` from `grid` to `target` along z, y and x."""
    axes = (zip(g.shape, g.voxel_size[::-1], g.origin[::-1]) for g in (grid, target))
    z, y, x = (resampling(old, new) for old, new in zip(*axes))
    return z, y, x


def along_axes(values: Tensor, matrices: tuple[Tensor, Tensor, Tensor]) -> Tensor:
    """Values [..., Z, Y, X] with each of these axes multiplied by its matrix."""
    for axis, matrix in zip((-1, -2, -3), matrices[::-1]):
        values = (values.movedim(axis, -1) @ matrix.T.to(values)).movedim(-1, axis)
    return values.contiguous()


def resampling(source: Axis, target: Axis) -> Tensor:
    """Matrix [m, n] float32 that takes values in n cells to values in m others along the same line.

    Onto cells as large, or larger: means of what they cover. Onto finer ones: linear between centres, with the end
    cells' values up to the ends. Both are zero where there is no source. The integral is kept; with finer cells, as
    far as they share the source's ends, or it is zero there.
    """
    (n, size, first), (m, wanted, start) = source, target
    cells, places = first + size * np.arange(n), start + wanted * np.arange(m)
    if wanted > (1 - 1e-9) * size:
        apart = np.abs(places[:, None] - cells)
        weights = np.clip((0.5 * (size + wanted) - apart) / wanted, 0, size / wanted)
    else:
        index = (places - first) / size
        inside = np.abs(index - 0.5 * (n - 1)) <= 0.5 * n
        nearest = np.clip(index, 0, n - 1)[:, None]
        weights = np.clip(1 - np.abs(nearest - np.arange(n)), 0, None) * inside[:, None]
    weights[weights < 1e-9] = 0
    return torch.from_numpy(weights).float()


class _Strips(torch.autograd.Function):
    """Line integrals by slice matrices, whose gradient is their adjoint."""

    @staticmethod
    def forward(ctx: Any, array: Tensor, projector: SliceProjector) -> Tensor:  # type: ignore[override]
        ctx.projector = projector
        return projector.project(array.detach().contiguous())

    @staticmethod
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor, None]:  # type: ignore[override]
        return ctx.projector.backproject(upstream.contiguous()), None


MOST_PROJECTORS = 16
"""Projectors that a grid keeps ready, one for each batch of views: as many as a fit of single views has at most."""


class VoxelGrid(Unmoved):
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


class BandLimitedVoxels(VoxelGrid):
    """Voxels whose lines about the y axis have nothing finer than a voxel, as those that hypotheses are judged by.

    On pixels that are so many times smaller, they are those of pixels as large as a voxel, and band-limited between
    their samples. Strips of a part of a voxel show the steps between voxels in views along the axes of the grid, which
    light behind strong matter turns into fringes.
    """

    @classmethod
    def of(cls, found: VoxelGrid) -> BandLimitedVoxels:
        """The same voxels, on their backend, with the projectors that they have ready."""
        made = cls(found.values, found.grid, found.matter)
        made.backend, made._projectors = found.backend, found._projectors
        return made

    def project(self, views: Views | Poses) -> LineIntegrals:
        """Line integrals (B, D), differentiable in the values."""
        seen = views if isinstance(views, Views) else views.views()
        (h, w), factor = seen.shape, self._finer(seen)
        lines = super().project(replace(seen, shape=(h // factor, w // factor), pitch=factor * seen.pitch))
        return LineIntegrals(between(lines.channels, factor), self.matter.channels)

    def _finer(self, views: Views) -> int:
        """Pixels along the edge of the smallest voxel, at most as many as make rows and columns of whole voxels."""
        if views.sources is not None or not views.shares_axis:
            return 1  # rays and hats, which have no steps
        h, w = views.shape
        most = math.floor(min(self.grid.voxel_size) / views.finest + 1 - SAME)
        return max((n for n in range(2, most + 1) if h % n == w % n == 0), default=1)
