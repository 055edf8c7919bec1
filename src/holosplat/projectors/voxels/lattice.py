"""Voxel-driven projection for any pose: fast, with an exact adjoint and pose gradients, for iterative tomography."""

from __future__ import annotations

import math
from types import ModuleType
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ...backends import device, implementation
from ...checks import require
from ...geometry import Grid, Poses, Views
from .lattice_kernels import reference
from .lattice_kernels.frames import Lattice


class LatticeProjector:
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

    def volume_in(self, volume: Tensor) -> Tensor:
        """The volume as it is: this projector's order is [Z, Y, X]."""
        return volume

    volume_out = volume_in

    def lines_in(self, images: Tensor) -> Tensor:
        """The images as they are: this projector's order is [V, H, W]."""
        return images

    lines_out = lines_in

    def _require(self, name: str, array: Tensor, wanted: tuple[int, ...]) -> None:
        shape, here = tuple(array.shape), array.device.type
        require(
            shape == wanted, f"the {name} must have the shape {wanted} of this projector, but the shape is {shape}."
        )
        there = self._device.type
        require(here == there, f"the {name} must be on the device {there!r} of this projector, but is on {here!r}.")


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
    poses = Poses.of(views) if isinstance(views, Views) else views
    lines: Tensor = _kernels(reference, grid, poses, detached=False).project(volume)
    return _spread(lines * _mass(grid, poses.pitch), poses.scales)
