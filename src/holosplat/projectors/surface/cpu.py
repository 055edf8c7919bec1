"""Thickness of closed surfaces on the CPU, by the compiled kernel, in float64.

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
    surface = native.Surface(points.shape[1], len(faces), points.data_ptr(), faces.data_ptr())
    raster = native.Raster(len(points), 1, *shape)
    native.call("holosplat_surface", surface, raster, lines, c_void_p(image.data_ptr()), torch.get_num_threads())
    return image
