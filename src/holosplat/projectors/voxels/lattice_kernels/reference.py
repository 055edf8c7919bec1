"""The lattice in plain torch, any float type: the specification, differentiable by autograd."""

from __future__ import annotations

import torch
from torch import Tensor

from . import KINK, SLACK, Lattice


class Kernels:
    """The projector of one lattice in V poses, before voxels' masses: matrices [V, 3, 3], shifts [V, 2] [px]."""

    def __init__(self, lattice: Lattice, matrices: Tensor, shifts: Tensor) -> None:
        self._lattice, self._poses = lattice, (matrices, shifts)

    def project(self, volume: Tensor) -> Tensor:
        """[Z, Y, X] → [V, H, W], differentiable in the volume, and in poses that ask for it."""
        points = _points(self._lattice).to(volume)
        # On either side of a kink the values are the same, and the derivatives are not.
        sides = (KINK, -KINK) if any(array.requires_grad for array in self._poses) else (0.0,)
        images = []
        for matrix, shift in zip(*self._poses):
            lab = matrix.to(volume)[:2] @ points
            images.append(_image(lab, shift, volume.reshape(-1), self._lattice.raster, sides))
        return torch.stack(images)

    def backproject(self, images: Tensor) -> Tensor:
        """The adjoint: [V, H, W] → [Z, Y, X]."""
        with torch.enable_grad():
            anything = images.new_zeros(self._lattice.shape).requires_grad_()
            return torch.autograd.grad(self.project(anything), anything, images)[0]

    def pose_gradients(self, volume: Tensor, upstream: Tensor) -> tuple[Tensor, Tensor]:
        """Of the matrices' first two rows [V, 2, 3] and of the shifts [V, 2], float64; upstream: of the images."""
        with torch.enable_grad():
            matrices, shifts = (array.detach().clone().requires_grad_() for array in self._poses)
            images = Kernels(self._lattice, matrices, shifts).project(volume.detach())
            rows, across = torch.autograd.grad(images, (matrices, shifts), upstream.to(images))
        return rows[:, :2], across


def _points(lattice: Lattice) -> Tensor:
    """The voxels' centres `(x, y, z)` [3, Z·Y·X] [px], float64."""
    ends = zip(lattice.origin, lattice.pitch, reversed(lattice.shape))
    x, y, z = (origin + pitch * torch.arange(count, dtype=torch.float64) for origin, pitch, count in ends)
    zz, yy, xx = torch.meshgrid(z, y, x, indexing="ij")
    return torch.stack([xx, yy, zz]).reshape(3, -1)


def _image(lab: Tensor, shift: Tensor, values: Tensor, raster: tuple[int, int], sides: tuple[float, ...]) -> Tensor:
    """One view [H, W] of `values` at `lab` [≥2, N]; the cells that hats lie on are the mean of those to the `sides`."""
    h, w = raster
    column, row = lab[0] - shift[0] + 0.5 * w - 0.5, lab[1] - shift[1] + 0.5 * h - 0.5
    kept = (column >= -SLACK) & (column <= w - 1 + SLACK) & (row >= -SLACK) & (row <= h - 1 + SLACK)
    column, row, value = column[kept], row[kept], values[kept] / len(sides)
    image = values.new_zeros(h * w)
    for side in sides:
        j, i = (column + side).floor().long().clamp(0, w - 2), (row + side).floor().long().clamp(0, h - 2)
        a, b, at = column - j, row - i, i * w + j
        for offset, weight in ((0, (1 - a) * (1 - b)), (1, a * (1 - b)), (w, (1 - a) * b), (w + 1, a * b)):
            image = image.index_add(0, at + offset, value * weight)
    return image.reshape(h, w)


class Stack:
    """Rays through a stack of slices [K, A, B], whose outermost rows and columns are zeros.

    rays: [5, N] in voxels: row in the middle of the stack, rows a slice, column there, columns a slice; and the ray's
    length from slice to slice. In every slice a ray sees the four voxels around its place, bilinear; beside the slice
    it sees the rim (Joseph 1982, *IEEE Trans. Med. Imaging* 1, 192-196).
    """

    def __init__(self, rays: Tensor) -> None:
        self._rays = rays

    def project(self, volume: Tensor) -> Tensor:
        """[K, A, B] → [N], differentiable in the volume and in the rays."""
        rays, (depth, height, width) = self._rays.to(volume), volume.shape
        seen = torch.zeros_like(rays[0])
        for k, voxels in enumerate(volume.reshape(depth, -1)):
            row, column = (at + (k - 0.5 * (depth - 1)) * step for at, step in (rays[0:2], rays[2:4]))
            row, column = row.clamp(0, height - 1), column.clamp(0, width - 1)
            i, j = row.detach().long().clamp(max=height - 2), column.detach().long().clamp(max=width - 2)
            a, b, at = column - j, row - i, i * width + j
            for offset, weight in ((0, (1 - a) * (1 - b)), (1, a * (1 - b)), (width, (1 - a) * b), (width + 1, a * b)):
                seen = seen + weight * voxels[at + offset]
        return seen * rays[4]

    def backproject(self, images: Tensor, volume: Tensor) -> None:
        """The adjoint, [N] → [K, A, B], which is added to `volume`."""
        with torch.enable_grad():
            anything = torch.zeros_like(volume).requires_grad_()
            volume += torch.autograd.grad(self.project(anything), anything, images.to(volume))[0]

    def gradients(self, volume: Tensor, upstream: Tensor) -> Tensor:
        """Of the rays [5, N]; upstream [N]: of the images."""
        with torch.enable_grad():
            rays = self._rays.detach().to(volume).requires_grad_()
            return torch.autograd.grad(Stack(rays).project(volume.detach()), rays, upstream.to(volume))[0]
