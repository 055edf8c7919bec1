"""Voxel-driven projection for any pose: fast, with an exact adjoint, for iterative tomography."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ... import native
from ...checks import require
from ...geometry import Grid, Views


class LatticeProjector:
    """Each voxel casts a bilinear hat of its mass on the detector; forward and exact adjoint, float32.

    Backends: `cpu` (compiled) and `reference` (`lattice_reference`, and its adjoint by autograd).

    The hat's variance, 1/6 px², is that of a pixel-sized cube's shadow (1/12) seen by a pixel (1/12), so voxels
    should be about as large as the raster's pixels. Single pixels carry a ripple of a few per cent where the
    lattice and the raster beat; their means do not. Arrays are volumes [Z, Y, X] and images [V, H, W]; grids
    of cubic voxels. Voxels at the very rim of the detector, with a pixel of their hat outside, are left out.
    """

    def __init__(self, grid: Grid, views: Views, backend: str = "cpu") -> None:
        require(np.allclose(grid.voxel_size, grid.voxel_size[0]), "the lattice projector needs cubic voxels.")
        self.grid, self.views, self.backend = grid, views, backend
        self.array_shape = grid.shape
        pixel = views.pixel_size
        self._rotations = np.ascontiguousarray(views.rotations)
        self._shifts = np.ascontiguousarray(views.shifts / pixel)
        rotations, shifts = (native.c_void_p(a.ctypes.data) for a in (self._rotations, self._shifts))
        self._views = native.Views(len(views), *views.shape, rotations, shifts)
        origin = (native.c_double * 3)(*(o / pixel for o in grid.origin))
        self._lattice = native.Lattice(*grid.shape, origin, grid.voxel_size[0] / pixel)
        self._mass = grid.voxel_size[0] ** 3 / pixel**2
        """Path length [m] that a voxel of value one adds to the pixels of its hat, in sum."""

    def project(self, array: Tensor) -> Tensor:
        """Line integrals [V, H, W] in metres × value of `array` [Z, Y, X]."""
        _check_shape("volume", array, self.grid.shape)
        if self.backend == "reference":
            return lattice_reference(array, self.grid, self.views)
        images = torch.empty(len(self.views), *self.views.shape)
        self._call("holosplat_lattice_project", array, images)
        return images.mul_(self._mass)

    def backproject(self, lines: Tensor) -> Tensor:
        """The adjoint of `project`: [V, H, W] → [Z, Y, X]."""
        _check_shape("line integrals", lines, (len(self.views), *self.views.shape))
        if self.backend == "reference":
            anything = torch.zeros(self.grid.shape, requires_grad=True)
            return torch.autograd.grad(lattice_reference(anything, self.grid, self.views), anything, lines)[0]
        volume = torch.empty(self.grid.shape)
        self._call("holosplat_lattice_backproject", lines, volume)
        return volume.mul_(self._mass)

    def volume_in(self, volume: Tensor) -> Tensor:
        """The volume as it is: this projector's order is [Z, Y, X]."""
        return volume

    volume_out = volume_in

    def lines_in(self, images: Tensor) -> Tensor:
        """The images as they are: this projector's order is [V, H, W]."""
        return images

    lines_out = lines_in

    def _call(self, function: str, source: Tensor, target: Tensor) -> None:
        source = source.detach().float().contiguous()
        pointers = [native.c_void_p(array.data_ptr()) for array in (source, target)]
        native.call(function, self._lattice, self._views, *pointers, torch.get_num_threads())


def _check_shape(name: str, array: Tensor, wanted: tuple[int, ...]) -> None:
    shape = tuple(array.shape)
    require(shape == wanted, f"the {name} must have the shape {wanted} of this projector, but the shape is {shape}.")


def lattice_reference(volume: Tensor, grid: Grid, views: Views) -> Tensor:
    """The plain form of `LatticeProjector.project`, any float type: [Z, Y, X] → [V, H, W]."""
    pixel, (h, w) = views.pixel_size, views.shape
    x, y, z = (torch.as_tensor(axis / pixel, dtype=volume.dtype) for axis in grid.axes())
    zz, yy, xx = torch.meshgrid(z, y, x, indexing="ij")
    points = torch.stack([xx, yy, zz]).reshape(3, -1)
    images = []
    for rotation, shift in zip(views.rotations, views.shifts / pixel):
        lab = torch.as_tensor(rotation, dtype=volume.dtype)[:2] @ points
        column, row = lab[0] - shift[0] + 0.5 * w - 0.5, lab[1] - shift[1] + 0.5 * h - 0.5
        slack = 1e-6
        kept = (column >= -slack) & (column <= w - 1 + slack) & (row >= -slack) & (row <= h - 1 + slack)
        j, i = column.floor().long().clamp(0, w - 2), row.floor().long().clamp(0, h - 2)
        a, b, value = (column - j)[kept], (row - i)[kept], volume.reshape(-1)[kept]
        at = (i * w + j)[kept]
        image = torch.zeros(h * w, dtype=volume.dtype)
        for offset, weight in ((0, (1 - a) * (1 - b)), (1, a * (1 - b)), (w, (1 - a) * b), (w + 1, a * b)):
            image = image.index_add(0, at + offset, value * weight)
        images.append(image.reshape(h, w))
    return torch.stack(images) * (grid.voxel_size[0] ** 3 / pixel**2)
