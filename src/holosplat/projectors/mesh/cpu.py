"""Depths of closed meshes on the CPU: the compiled kernel, in float64, the same for every number of threads."""

from __future__ import annotations

from ctypes import c_void_p

import torch
from torch import Tensor

from ... import native
from .reference import on_lattice


def mean_depths(
    lab: Tensor, faces: Tensor, values: Tensor, shape: tuple[int, int], pitch: float, rays: int, bent: float = 0.0
) -> Tensor:
    """As the reference's function."""
    points, faces, values = on_lattice(lab, shape, pitch, rays), faces.contiguous(), values.contiguous()
    image = values.new_empty(len(values), *shape)
    mesh = native.Surface(len(points), len(faces), points.data_ptr(), faces.data_ptr())
    arrays = [c_void_p(values.data_ptr()), rays, bent, c_void_p(image.data_ptr())]
    native.call("holosplat_mesh_depths", mesh, native.Raster(1, *image.shape), *arrays, torch.get_num_threads())
    return image
