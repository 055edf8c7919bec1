"""The lattice on the GPU, in float32: the Triton kernels beside this file.

Nothing here waits for the device. Images are sums in any order and differ in their last bits from run to run; volumes
and gradients of poses, for equal images, do not.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ....launch import launching
from . import Lattice, triton_lattice


class Kernels:
    """The projector of one lattice in V poses, before voxels' masses: matrices [V, 3, 3], shifts [V, 2] [px]."""

    def __init__(self, lattice: Lattice, matrices: Tensor, shifts: Tensor) -> None:
        self._lattice = lattice
        self._axes = _axes(lattice, matrices, shifts)

    def project(self, volume: Tensor) -> Tensor:
        """[Z, Y, X] → [V, H, W]."""
        with launching(volume):
            return triton_lattice.project(self._axes, _plain(volume), self._lattice.raster)

    def backproject(self, images: Tensor) -> Tensor:
        """The adjoint: [V, H, W] → [Z, Y, X]."""
        with launching(images):
            return triton_lattice.backproject(self._axes, _plain(images), self._lattice.shape)

    def pose_gradients(self, volume: Tensor, upstream: Tensor) -> tuple[Tensor, Tensor]:
        """Of the matrices' first two rows [V, 2, 3] and of the shifts [V, 2], float64; upstream: of the images."""
        with launching(volume):
            sums = triton_lattice.pose_sums(self._axes, _plain(volume), _plain(upstream))
        everything = sums[:, :, 0]
        ends = zip(self._lattice.origin, self._lattice.pitch, sums[:, :, 1:].unbind(2))
        rows = [origin * everything + pitch * by_index for origin, pitch, by_index in ends]
        return torch.stack(rows, 2), -everything


def _axes(lattice: Lattice, matrices: Tensor, shifts: Tensor) -> Tensor:
    """[V, 2, 4] float64: column and row of voxel (z, y, x) are `start + z dz + y dy + x dx`, four numbers each."""
    (ox, oy, oz), (px, py, pz), (h, w) = lattice.origin, lattice.pitch, lattice.raster
    axes = []
    for k, count in enumerate((w, h)):
        x, y, z = matrices[:, k].unbind(1)
        start = x * ox + y * oy + z * oz - shifts[:, k] + (0.5 * count - 0.5)
        axes.append(torch.stack([start, z * pz, y * py, x * px], 1))
    return torch.stack(axes, 1)


def _plain(array: Tensor) -> Tensor:
    return array.detach().float().contiguous()


class Stack:
    """Rays through slices: rays [5, N] as in `reference.Stack`."""

    def __init__(self, rays: Tensor) -> None:
        self._rays = _plain(rays)

    def project(self, volume: Tensor) -> Tensor:
        """[K, A, B] → [N]."""
        with launching(volume):
            return triton_lattice.project_rays(self._rays, _plain(volume))

    def backproject(self, images: Tensor, volume: Tensor) -> None:
        """The adjoint, [N] → [K, A, B], which is added to `volume`, float32 and contiguous, in any order."""
        with launching(volume):
            triton_lattice.backproject_rays(self._rays, _plain(images), volume)

    def gradients(self, volume: Tensor, upstream: Tensor) -> Tensor:
        """Of the rays [5, N]; upstream [N]: of the images."""
        with launching(volume):
            return triton_lattice.ray_gradients(self._rays, _plain(volume), _plain(upstream))
