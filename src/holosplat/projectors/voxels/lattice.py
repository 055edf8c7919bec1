"""Projection for any pose, exact adjoints, gradients of poses: voxels that cast hats, and rays, those of cones, too."""

from __future__ import annotations

import math
from collections.abc import Iterator
from types import ModuleType
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import pad

from ...backends import device, implementation
from ...checks import require
from ...geometry import Grid, Poses, Views
from .lattice_kernels import Lattice, reference


class _Plain:
    """Arrays in their plain order: volumes [Z, Y, X] and images [V, H, W]."""

    def volume_in(self, volume: Tensor) -> Tensor:
        """The volume as it is: this projector's order is [Z, Y, X]."""
        return volume

    volume_out = volume_in

    def lines_in(self, images: Tensor) -> Tensor:
        """The images as they are: this projector's order is [V, H, W]."""
        return images

    lines_out = lines_in


class LatticeProjector(_Plain):
    """Each voxel casts a bilinear hat of its mass on the detector; forward and exact adjoint, float32.

    Backends: `cpu` (C++), `cuda` (Triton) and `reference` (plain torch, any float type, derivatives by autograd). Poses
    and arrays are given and made where the backend computes.

    The hat's variance, 1/6 px², is the sum of the variances of a pixel-sized cube's shadow (1/12) and of a pixel
    (1/12), so voxels should be about as large as the raster's pixels. Single pixels carry a ripple of a few per cent
    where the lattice and the raster beat; their means do not. Arrays are volumes [Z, Y, X] and images [V, H, W]. Voxels
    at the very rim of the detector, with a pixel of their hat outside, are left out.

    Where pixel sizes differ, a view of pixels `s p` is one of pixels p with the matrix `R / s`, and a voxel's mass is
    spread over s² pixels p².

    The projector uses the poses as they are when it is made. Gradients of poses are exact, except for matter that
    enters or leaves at the detector's rim, and for voxels on a pixel's centre, where hats have a kink: there the
    gradient is the mean of both sides.
    """

    def __init__(self, grid: Grid, views: Views | Poses, backend: str = "cpu") -> None:
        self.grid, self.views, self.backend = grid, views, backend
        self.array_shape = grid.shape
        self._device = device(backend)
        views.parallel("the lattice of voxels")
        poses = Poses.of(views, self._device) if isinstance(views, Views) else _checked(views, self._device)
        self._poses = poses
        self._kernels = _kernels(implementation(f"{__package__}.lattice_kernels", backend), grid, poses, detached=True)
        self._mass = _mass(grid, poses.pitch)
        self._scales = None if poses.scales is None else poses.scales.detach().clone()

    def lines(self, array: Tensor) -> Tensor:
        """As `project`, differentiable: in `array`, and in the poses that ask for gradients."""
        if self.backend == "reference":
            return lattice_reference(array, self.grid, self._poses)
        poses = self._poses
        lines = _Lines.apply(array, poses.matrices, poses.offsets, self)
        assert isinstance(lines, Tensor)
        return _spread(lines, poses.scales)

    def project(self, array: Tensor) -> Tensor:
        """Line integrals [V, H, W] in metres × value of `array` [Z, Y, X]."""
        return _spread(self.on_pixels(array), self._scales)

    def on_pixels(self, array: Tensor) -> Tensor:
        """As `project`, before a voxel's mass is spread over larger pixels."""
        self._require("volume", array, self.grid.shape)
        images: Tensor = self._kernels.project(array)
        return images.mul_(self._mass)

    def backproject(self, lines: Tensor) -> Tensor:
        """The adjoint of `project`: [V, H, W] → [Z, Y, X]."""
        return self.from_pixels(_spread(lines, self._scales))

    def from_pixels(self, lines: Tensor) -> Tensor:
        """The adjoint of `on_pixels`."""
        self._require("line integrals", lines, (len(self.views), *self.views.shape))
        volume: Tensor = self._kernels.backproject(lines)
        return volume.mul_(self._mass)

    def pose_gradients(self, array: Tensor, upstream: Tensor) -> tuple[Tensor, Tensor]:
        """Gradients of matrices [V, 3, 3] and offsets [V, 2] [1/m], of the gradient [V, H, W] of `on_pixels`.

        float64; the matrices' last rows, which move voxels along the beam, are zero.
        """
        rows, shifts = self._kernels.pose_gradients(array, upstream)
        matrices = torch.cat((rows, rows.new_zeros(len(rows), 1, 3)), 1)
        return matrices.mul_(self._mass), shifts.mul(self._mass / self.views.pitch)

    def _require(self, name: str, array: Tensor, wanted: tuple[int, ...]) -> None:
        _require(name, array, wanted, self._device)


RAYS_KEPT = 1 << 22
"""Rays of projectors, at most, that are kept between calls, 20 bytes each; more are made anew, view by view."""
STACKED = ((2, 0, 1), (1, 0, 2), (0, 2, 1))
"""For slices across x, y and z: the axes of [Z, Y, X] that are their number, rows and columns."""
Piece = tuple[int, int, Tensor | None, Tensor]
"""A view, the axis that its rays go along, which of its pixels these are (None: all), and these rays [5, N]."""


class RayProjector(_Plain):
    """A ray from the source to the centre of every pixel, parallel or of a cone, sees voxels linear between their
    centres and zero beyond the next one outside the volume; forward and exact adjoint, float32.

    Backends: `cpu` (C++), `cuda` (Triton) and `reference` (plain torch, any float type). Poses and arrays are given and
    made where the backend computes. Arrays are volumes [Z, Y, X] and images [V, H, W] of line integrals in metres ×
    value. A ray is sampled once a slice, of those that it crosses most steeply, by Joseph's method (1982, *IEEE Trans.
    Med. Imaging* 1, 192-196): the error falls with the square of the voxels' size where matter is smooth. Voxels should
    be about as large as pixels: rays do not see what lies between them.

    The projector uses the poses as they are when it is made. `lines` is differentiable in rotations, shifts, scales and
    sources of poses that ask for it.
    """

    def __init__(self, grid: Grid, views: Views | Poses, backend: str = "cpu") -> None:
        self.grid, self.views, self.backend = grid, views, backend
        self.array_shape = grid.shape
        self._device = device(backend)
        self._poses = Poses.of(views, self._device) if isinstance(views, Views) else _checked(views, self._device)
        self._stack = implementation(f"{__package__}.lattice_kernels", backend).Stack
        few = len(views) * math.prod(views.shape) <= RAYS_KEPT and not self._poses.requires_grad
        self._kept = list(self._made()) if few else None

    def lines(self, array: Tensor) -> Tensor:
        """As `project`, differentiable: in `array`, and in the poses that ask for gradients."""
        self._require("volume", array, self.grid.shape)
        stacks = dict[int, Tensor]()
        h, w = self.views.shape
        images: list[Tensor | None] = [None] * len(self.views)
        for v, axis, pixels, rays in self._pieces():
            if axis not in stacks:
                stacks[axis] = pad(array.permute(STACKED[axis]), (1, 1, 1, 1)).contiguous()
            seen = self._stack(rays).project(stacks[axis]) if self._plain else self._seen(stacks[axis], rays)
            if pixels is not None:
                before = images[v]
                seen = (seen.new_zeros(w * h) if before is None else before).index_copy(0, pixels, seen)
            images[v] = seen
        return torch.stack([image for image in images if image is not None]).reshape(-1, w, h).transpose(1, 2)

    def project(self, array: Tensor) -> Tensor:
        """Line integrals [V, H, W] in metres × value of `array` [Z, Y, X]."""
        with torch.no_grad():
            return self.lines(array if self._plain else array.float())

    def backproject(self, lines: Tensor) -> Tensor:
        """The adjoint of `project`: [V, H, W] → [Z, Y, X]."""
        self._require("line integrals", lines, (len(self.views), *self.views.shape))
        lines = (lines.detach() if self._plain else lines.detach().float()).transpose(1, 2).flatten(1)
        stacks = dict[int, Tensor]()
        with torch.no_grad():
            for v, axis, pixels, rays in self._pieces():
                if axis not in stacks:
                    depth, height, width = (self.grid.shape[k] for k in STACKED[axis])
                    stacks[axis] = lines.new_zeros(depth, height + 2, width + 2)
                self._stack(rays).backproject(lines[v] if pixels is None else lines[v, pixels], stacks[axis])
            volume = lines.new_zeros(self.grid.shape)
            for axis, stack in stacks.items():
                volume += stack[:, 1:-1, 1:-1].permute([STACKED[axis].index(k) for k in range(3)])
        return volume

    @property
    def _plain(self) -> bool:
        return self.backend == "reference"

    def _seen(self, stack: Tensor, rays: Tensor) -> Tensor:
        seen = _Rays.apply(stack, rays, self._stack)
        assert isinstance(seen, Tensor)
        return seen

    def _require(self, name: str, array: Tensor, wanted: tuple[int, ...]) -> None:
        _require(name, array, wanted, self._device)

    def _pieces(self) -> Iterator[Piece]:
        return iter(self._kept) if self._kept is not None else self._made()

    def _made(self) -> Iterator[Piece]:
        for v in range(len(self.views)):
            at, by, length = _rays(self.grid, self._poses, v)
            for axis, pixels in _axes_of(by.detach(), self.views.shape):
                if pixels is None:
                    rays = _through(at, by, length, axis, self.grid)
                else:
                    rays = _through(at[:, pixels], by[:, pixels], length[pixels], axis, self.grid)
                yield v, axis, pixels, rays if self._plain else rays.float()


def _axes_of(by: Tensor, raster: tuple[int, int]) -> Iterator[tuple[int, Tensor | None]]:
    """The axes that rays [3, W·H] go along most steeply, each with the numbers of its rays; None for all."""
    h, w = raster
    ends = torch.tensor([0, h - 1, (w - 1) * h, w * h - 1], device=by.device)
    corners = by[:, ends]
    steepest = corners.abs().argmax(0).tolist()
    if steepest == steepest[:1] * 4 and abs(int(corners[steepest[0]].sign().sum())) == 4:
        yield steepest[0], None  # directions that are steepest along an axis are a convex set
        return
    x, y, z = by.abs()
    along_z = z >= torch.maximum(x, y)
    for axis, mask in enumerate((~along_z & (x >= y), ~along_z & (x < y), along_z)):
        pixels = mask.nonzero()[:, 0]
        if len(pixels):
            yield axis, pixels


def _rays(grid: Grid, poses: Poses, v: int) -> tuple[Tensor, Tensor, Tensor]:
    """Of a view's pixels, in columns: where their centres lie and where their rays go, each [3, W·H] float64, x, y, z
    in voxels, and the length [W·H] [m] of the latter."""
    (h, w), there = poses.shape, poses.rotations.device
    pixel = poses.pitch if poses.scales is None else poses.pitch * poses.scales[v]
    x, y = (torch.arange(n, dtype=torch.float64, device=there) - 0.5 * (n - 1) for n in (w, h))
    x, y = (pixel * x + poses.shifts[v, 0])[:, None], pixel * y + poses.shifts[v, 1]
    origin, size = (torch.tensor(a, dtype=torch.float64, device=there)[:, None] for a in (grid.origin, grid.voxel_size))
    along_x, along_y, along_z = (poses.rotations[v].T / size).unbind(1)
    plane = (along_x[:, None, None] * x + along_y[:, None, None] * y).reshape(3, -1)
    by, length = along_z[:, None].expand_as(plane), torch.ones_like(plane[0])
    if poses.sources is not None:
        by = by + plane / poses.sources[v]
        length = (1 + (x.square() + y.square()) / poses.sources[v].square()).sqrt().reshape(-1)
    return plane - origin / size, by, length


def _through(at: Tensor, by: Tensor, length: Tensor, axis: int, grid: Grid) -> Tensor:
    """Rays [5, N] of a stack of slices across `axis`, of `_rays`' numbers."""
    slices, rows, columns = (2 - k for k in STACKED[axis])  # from axes of [Z, Y, X] to x, y, z
    row_step, step = by[rows] / by[slices], by[columns] / by[slices]
    middle = 0.5 * (grid.shape[2 - slices] - 1) - at[slices]
    row, column = at[rows] + middle * row_step + 1, at[columns] + middle * step + 1  # the rim is one voxel wide
    return torch.stack((row, row_step, column, step, length / by[slices].abs()))


class _Rays(torch.autograd.Function):
    """Line integrals of a backend along rays, whose gradients are its adjoint and `gradients`."""

    @staticmethod
    def forward(ctx: Any, stack: Tensor, rays: Tensor, kernels: Any) -> Tensor:  # type: ignore[override]
        ctx.kernels = kernels
        ctx.save_for_backward(stack, rays)
        seen: Tensor = kernels(rays).project(stack)
        return seen

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, Tensor | None, None]:  # type: ignore[override]
        (stack, rays), of_stack, of_rays = ctx.saved_tensors, None, None
        kernels, upstream = ctx.kernels(rays), upstream.float().contiguous()
        if ctx.needs_input_grad[0]:
            of_stack = torch.zeros_like(stack, dtype=torch.float32)
            kernels.backproject(upstream, of_stack)
        if ctx.needs_input_grad[1]:
            of_rays = kernels.gradients(stack, upstream)
        return of_stack, of_rays, None


class _Lines(torch.autograd.Function):
    """The projector of a backend, whose gradient is its adjoint; of the poses, `pose_gradients`."""

    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any, array: Tensor, matrices: Tensor, offsets: Tensor, projector: LatticeProjector
    ) -> Tensor:
        ctx.projector = projector
        ctx.save_for_backward(array if any(ctx.needs_input_grad[1:3]) else None)
        return projector.on_pixels(array)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        (array,), upstream = ctx.saved_tensors, upstream.float().contiguous()
        of_array = ctx.projector.from_pixels(upstream) if ctx.needs_input_grad[0] else None
        poses = (None, None) if array is None else ctx.projector.pose_gradients(array, upstream)
        return of_array, *poses, None


def _require(name: str, array: Tensor, wanted: tuple[int, ...], where: torch.device) -> None:
    shape, here, there = tuple(array.shape), array.device.type, where.type
    require(shape == wanted, f"the {name} must have the shape {wanted} of this projector, but the shape is {shape}.")
    require(here == there, f"the {name} must be on the device {there!r} of this projector, but is on {here!r}.")


def _checked(poses: Poses, device: torch.device) -> Poses:
    fits = poses.rotations.ndim == 3 and poses.rotations.shape[1:] == (3, 3)
    fits = fits and tuple(poses.shifts.shape) == (len(poses), 2)
    held = [(a.dtype, a.device.type) for a in (poses.rotations, poses.shifts)]
    require(
        fits and set(held) == {(torch.float64, device.type)},
        f"poses of voxels must be float64 tensors on {device.type!r}, rotations (V, 3, 3) and shifts (V, 2), but they "
        f"are {tuple(poses.rotations.shape)} and {tuple(poses.shifts.shape)}, {held}.",
    )
    return poses


def _kernels(backend: ModuleType, grid: Grid, poses: Poses, *, detached: bool) -> Any:
    """A backend's projector for the poses; detached: for what they are now, without gradients."""
    pixel, (x, y, z), (dx, dy, dz) = poses.pitch, grid.origin, grid.voxel_size
    origin, pitch = (x / pixel, y / pixel, z / pixel), (dx / pixel, dy / pixel, dz / pixel)
    matrices, shifts = poses.matrices, poses.offsets / pixel
    if detached:
        matrices, shifts = matrices.detach().clone(), shifts.detach()
    return backend.Kernels(Lattice(grid.shape, origin, pitch, poses.shape), matrices, shifts)


def _mass(grid: Grid, pixel: float) -> float:
    """Path length [m] that a voxel of value one adds to the pixels of its hat, in sum."""
    return math.prod(grid.voxel_size) / pixel**2


def _spread(lines: Tensor, scales: Tensor | None) -> Tensor:
    """Line integrals whose mass is spread over pixels of other sizes."""
    return lines if scales is None else lines * scales[:, None, None].to(lines.dtype) ** -2


def lattice_reference(volume: Tensor, grid: Grid, views: Views | Poses) -> Tensor:
    """The plain form of `LatticeProjector.lines`, any float type: [Z, Y, X] → [V, H, W]."""
    poses = Poses.of(views) if isinstance(views, Views) else views.parallel("the lattice of voxels")
    lines: Tensor = _kernels(reference, grid, poses, detached=False).project(volume)
    return _spread(lines * _mass(grid, poses.pitch), poses.scales)
