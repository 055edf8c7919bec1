"""Voxel-driven projection for any pose: fast, with an exact adjoint and pose gradients, for iterative tomography."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ... import native
from ...checks import require
from ...geometry import Grid, Poses, Views

KINK = 1e-6
"""Pixels from a pixel's centre within which a voxel counts as lying on it."""


class LatticeProjector:
    """Each voxel casts a bilinear hat of its mass on the detector; forward and exact adjoint, float32.

    Backends: `cpu` (compiled) and `reference` (`lattice_reference`, and its derivatives by autograd).

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
        self._poses = Poses.of(views) if isinstance(views, Views) else _checked(views)
        pixel, poses = views.pitch, self._poses
        self._arrays = (poses.matrices.detach().clone(), poses.offsets.detach() / pixel)
        self._native = native.Views(len(views), *views.shape, *(a.data_ptr() for a in self._arrays))
        origin, pitch = ((native.c_double * 3)(*(a / pixel for a in ends)) for ends in (grid.origin, grid.voxel_size))
        self._lattice = native.Lattice(*grid.shape, origin, pitch)
        self._mass = _mass(grid, pixel)
        self._spread = None if poses.scales is None else poses.scales.detach()[:, None, None].float() ** -2

    def lines(self, array: Tensor) -> Tensor:
        """As `project`, differentiable: in `array`, and in the poses that ask for gradients."""
        if self.backend == "reference":
            return lattice_reference(array, self.grid, self._poses)
        poses = self._poses
        lines = _Lines.apply(array, poses.matrices, poses.offsets, self)
        assert isinstance(lines, Tensor)
        return lines if poses.scales is None else lines * poses.scales[:, None, None].float() ** -2

    def project(self, array: Tensor) -> Tensor:
        """Line integrals [V, H, W] in metres × value of `array` [Z, Y, X]."""
        _check_shape("volume", array, self.grid.shape)
        if self.backend == "reference":
            return lattice_reference(array, self.grid, self.views)
        images = self.on_pixels(array)
        return images if self._spread is None else images.mul_(self._spread)

    def on_pixels(self, array: Tensor) -> Tensor:
        """As `project`, before a voxel's mass is spread over larger pixels; by the compiled kernel."""
        images = torch.empty(len(self.views), *self.views.shape)
        self._call("holosplat_lattice_project", array, images)
        return images.mul_(self._mass)

    def backproject(self, lines: Tensor) -> Tensor:
        """The adjoint of `project`: [V, H, W] → [Z, Y, X]."""
        _check_shape("line integrals", lines, (len(self.views), *self.views.shape))
        if self.backend == "reference":
            anything = torch.zeros(self.grid.shape, requires_grad=True)
            return torch.autograd.grad(lattice_reference(anything, self.grid, self.views), anything, lines)[0]
        return self.from_pixels(lines if self._spread is None else lines * self._spread)

    def from_pixels(self, lines: Tensor) -> Tensor:
        """The adjoint of `on_pixels`."""
        volume = torch.empty(self.grid.shape)
        self._call("holosplat_lattice_backproject", lines, volume)
        return volume.mul_(self._mass)

    def pose_gradients(self, array: Tensor, upstream: Tensor) -> tuple[Tensor, Tensor]:
        """Gradients of matrices [V, 3, 3] and offsets [V, 2] [1/m], of the gradient [V, H, W] of `on_pixels`.

        float64; the matrices' last rows, which move voxels along the beam, are zero. By the compiled kernel.
        """
        rotations = torch.zeros(len(self.views), 2, 3, dtype=torch.float64)
        shifts = torch.zeros(len(self.views), 2, dtype=torch.float64)
        if min(self.views.shape) > 1:
            self._call("holosplat_lattice_poses", array, upstream, rotations, shifts)
        last = torch.zeros(len(self.views), 1, 3, dtype=torch.float64)
        return torch.cat((rotations, last), 1).mul_(self._mass), shifts.mul_(self._mass / self.views.pitch)

    def volume_in(self, volume: Tensor) -> Tensor:
        """The volume as it is: this projector's order is [Z, Y, X]."""
        return volume

    volume_out = volume_in

    def lines_in(self, images: Tensor) -> Tensor:
        """The images as they are: this projector's order is [V, H, W]."""
        return images

    lines_out = lines_in

    def _call(self, function: str, source: Tensor, *others: Tensor) -> None:
        source = source.detach().float().contiguous()
        pointers = [native.c_void_p(array.data_ptr()) for array in (source, *others)]
        native.call(function, self._lattice, self._native, *pointers, torch.get_num_threads())


class _Lines(torch.autograd.Function):
    """The compiled projector, whose gradient is its adjoint; of the poses, `pose_gradients`."""

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


def _checked(poses: Poses) -> Poses:
    fits = poses.rotations.ndim == 3 and poses.rotations.shape[1:] == (3, 3)
    fits = fits and tuple(poses.shifts.shape) == (len(poses), 2)
    held = [(a.dtype, a.device.type) for a in (poses.rotations, poses.shifts)]
    require(
        fits and set(held) == {(torch.float64, "cpu")},
        "poses of voxels must be float64 tensors on the CPU, rotations (V, 3, 3) and shifts (V, 2), but they are "
        f"{tuple(poses.rotations.shape)} and {tuple(poses.shifts.shape)}, {held}.",
    )
    return poses


def _check_shape(name: str, array: Tensor, wanted: tuple[int, ...]) -> None:
    shape = tuple(array.shape)
    require(shape == wanted, f"the {name} must have the shape {wanted} of this projector, but the shape is {shape}.")


def _mass(grid: Grid, pixel: float) -> float:
    """Path length [m] that a voxel of value one adds to the pixels of its hat, in sum."""
    return math.prod(grid.voxel_size) / pixel**2


def lattice_reference(volume: Tensor, grid: Grid, views: Views | Poses) -> Tensor:
    """The plain form of `LatticeProjector.lines`, any float type: [Z, Y, X] → [V, H, W]."""
    poses = Poses.of(views) if isinstance(views, Views) else views
    pixel, (h, w) = poses.pitch, poses.shape
    x, y, z = (torch.as_tensor(axis / pixel, dtype=volume.dtype) for axis in grid.axes())
    zz, yy, xx = torch.meshgrid(z, y, x, indexing="ij")
    points = torch.stack([xx, yy, zz]).reshape(3, -1)
    # On either side of a kink the values are the same, and the derivatives are not.
    sides = (KINK, -KINK) if poses.requires_grad else (0.0,)
    images = []
    for rotation, shift in zip(poses.matrices, poses.offsets / pixel):
        lab = rotation.to(volume.dtype)[:2] @ points
        column, row = lab[0] - shift[0] + 0.5 * w - 0.5, lab[1] - shift[1] + 0.5 * h - 0.5
        slack = 1e-6
        kept = (column >= -slack) & (column <= w - 1 + slack) & (row >= -slack) & (row <= h - 1 + slack)
        column, row, value = column[kept], row[kept], volume.reshape(-1)[kept] / len(sides)
        image = torch.zeros(h * w, dtype=volume.dtype)
        for side in sides:
            j, i = (column + side).floor().long().clamp(0, w - 2), (row + side).floor().long().clamp(0, h - 2)
            a, b, at = column - j, row - i, i * w + j
            for offset, weight in ((0, (1 - a) * (1 - b)), (1, a * (1 - b)), (w, (1 - a) * b), (w + 1, a * b)):
                image = image.index_add(0, at + offset, value * weight)
        images.append(image.reshape(h, w))
    lines = torch.stack(images) * _mass(grid, pixel)
    return lines if poses.scales is None else lines * poses.scales[:, None, None].to(lines) ** -2
