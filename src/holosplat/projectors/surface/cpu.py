"""Thickness of closed surfaces, and its gradients, on the CPU: the compiled kernels, in float64.

Bitwise the same for every number of threads (torch's: `torch.set_num_threads`) and in every run.
"""

from __future__ import annotations

from ctypes import c_void_p

import torch
from torch import Tensor

from ... import native


def thickness(points: Tensor, faces: Tensor, shape: tuple[int, int], lines: int) -> Tensor:
    """[V, H, W] float64 of points [V, P, 3] `(column, row, depth)`; arguments as the package's function, checked."""
    points, faces = points.contiguous(), faces.contiguous()
    image = points.new_empty(len(points), *shape)
    surface, raster = _surface(points, faces), native.Raster(len(points), 1, *shape)
    native.call("holosplat_surface", surface, raster, lines, c_void_p(image.data_ptr()), torch.get_num_threads())
    return image


def corner_shares(points: Tensor, faces: Tensor, gradient: Tensor, weights: Tensor) -> Tensor:
    """What each corner of each face gets of the image's gradient [V, H, W], views weighed by `weights` [V]: [F, 3]."""
    points, faces, gradient, weights = (a.contiguous() for a in (points, faces, gradient, weights))
    shares = points.new_empty(len(faces), 3)
    surface, raster = _surface(points, faces), native.Raster(len(points), 1, *gradient.shape[1:])
    arrays = [c_void_p(a.data_ptr()) for a in (gradient, weights, shares)]
    native.call("holosplat_surface_shares", surface, raster, *arrays, torch.get_num_threads())
    return shares


def pose_gradients(points: Tensor, vertices: Tensor, faces: Tensor, gradient: Tensor) -> tuple[Tensor, Tensor]:
    """Gradients of rotations [V, 3, 3] and shifts [V, 2], of the image's [V, H, W]; float64, lengths in pixels."""
    points, vertices, faces, gradient = (a.contiguous() for a in (points, vertices, faces, gradient))
    surface, raster = _surface(points, faces), native.Raster(len(points), 1, *gradient.shape[1:])
    rotations, shifts = points.new_empty(len(points), 3, 3), points.new_empty(len(points), 2)
    arrays = [c_void_p(a.data_ptr()) for a in (vertices, gradient, rotations, shifts)]
    native.call("holosplat_surface_poses", surface, raster, *arrays, torch.get_num_threads())
    return rotations, shifts


def _surface(points: Tensor, faces: Tensor) -> native.Surface:
    return native.Surface(points.shape[1], len(faces), points.data_ptr(), faces.data_ptr())
