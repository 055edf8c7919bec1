"""Splat and voxeliser on the GPU: the Triton kernels beside this file, in float32.

Nothing here waits for the device, and launches depend on shapes alone, so that all of it can be captured in a CUDA
graph once the kernels are compiled (by a first call outside the capture) and the views are on the device. Images are
sums in any order and differ in their last bits from run to run; gradients, for an equal image gradient, do not.
"""

from __future__ import annotations

import torch
from torch import Tensor

from . import triton_splat, triton_voxels
from .gradients import Arrays, Poses, drawn


def splat(cloud: Arrays, poses: Poses, shape: tuple[int, ...], cutoff: float, variance: float) -> Tensor:
    """Line integrals [V, C, H, W]; arguments and units as the package's `splat`, already checked.

    Poses in float64 on the device are used where they lie; from elsewhere they are copied.
    """
    there = [None if a is None else a.to(cloud[0].device, torch.float64).contiguous() for a in poses]
    return drawn(
        cloud,
        there,
        lambda cloud, poses: triton_splat.draw(tuple(cloud), poses, shape, cutoff, variance),
        lambda cloud, poses, kept, gradient, moves: triton_splat.gather(cloud, poses, kept, gradient, variance, moves),
    )


def voxelise(cloud: Arrays, shape: tuple[int, ...], cutoff: float, variance: float) -> Tensor:
    """Samples [C, Z, Y, X]; arguments and units as the package's `voxelise`, already checked."""
    return drawn(
        cloud,
        (None, None, None),
        lambda cloud, poses: triton_voxels.draw(tuple(cloud), shape, cutoff, variance),
        lambda cloud, poses, kept, gradient, moves: (triton_voxels.gather(cloud, kept, gradient, variance), poses),
    )
