"""The lattice by the compiled kernels, float32 in main memory."""

from __future__ import annotations

import torch
from torch import Tensor

from .... import native
from . import Lattice


class Kernels:
    """The projector of one lattice in V poses, before voxels' masses: matrices [V, 3, 3], shifts [V, 2] [px]."""

    def __init__(self, lattice: Lattice, matrices: Tensor, shifts: Tensor) -> None:
        self._images = (len(matrices), *lattice.raster)
        self._volume = lattice.shape
        self._poses = (matrices.contiguous(), shifts.contiguous())  # which must outlive the pointers
        self._views = native.Views(*self._images, *(array.data_ptr() for array in self._poses), None)
        ends = ((native.c_double * 3)(*end) for end in (lattice.origin, lattice.pitch))
        self._lattice = native.Lattice(*lattice.shape, *ends)

    def project(self, volume: Tensor) -> Tensor:
        """[Z, Y, X] → [V, H, W]."""
        images = torch.empty(self._images)
        self._call("holosplat_lattice_project", volume, images)
        return images

    def backproject(self, images: Tensor) -> Tensor:
        """The adjoint: [V, H, W] → [Z, Y, X]."""
        volume = torch.empty(self._volume)
        self._call("holosplat_lattice_backproject", images, volume)
        return volume

    def pose_gradients(self, volume: Tensor, upstream: Tensor) -> tuple[Tensor, Tensor]:
        """Of the matrices' first two rows [V, 2, 3] and of the shifts [V, 2], float64; upstream: of the images."""
        rows = torch.zeros(self._images[0], 2, 3, dtype=torch.float64)
        shifts = torch.zeros(self._images[0], 2, dtype=torch.float64)
        self._call("holosplat_lattice_poses", volume, _plain(upstream), rows, shifts)
        return rows, shifts

    def _call(self, function: str, source: Tensor, *others: Tensor) -> None:
        arrays = (_plain(source), *others)
        pointers = [native.c_void_p(array.data_ptr()) for array in arrays]
        native.call(function, self._lattice, self._views, *pointers, torch.get_num_threads())


def _plain(array: Tensor) -> Tensor:
    return array.detach().float().contiguous()


class Stack:
    """Rays through slices: rays [5, N] as in `reference.Stack`."""

    def __init__(self, rays: Tensor) -> None:
        self._rays = _plain(rays)

    def project(self, volume: Tensor) -> Tensor:
        """[K, A, B] → [N]."""
        images = torch.empty(self._rays.shape[1])
        self._call("holosplat_rays_project", volume.shape, _plain(volume), images)
        return images

    def backproject(self, images: Tensor, volume: Tensor) -> None:
        """The adjoint, [N] → [K, A, B], which is added to `volume`, float32 and contiguous."""
        self._call("holosplat_rays_backproject", volume.shape, _plain(images), volume)

    def gradients(self, volume: Tensor, upstream: Tensor) -> Tensor:
        """Of the rays [5, N]; upstream [N]: of the images."""
        found = torch.empty_like(self._rays)
        self._call("holosplat_rays_gradients", volume.shape, _plain(volume), _plain(upstream), found)
        return found

    def _call(self, function: str, shape: torch.Size, *arrays: Tensor) -> None:
        rays = native.Rays(*shape, self._rays.shape[1], self._rays.data_ptr())
        native.call(function, rays, *(native.c_void_p(a.data_ptr()) for a in arrays), torch.get_num_threads())
