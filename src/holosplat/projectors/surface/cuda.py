"""Thickness of closed surfaces, and its gradients, on the GPU: the Triton kernels beside this file, in float64.

Nothing here waits for the device. Images are sums in any order and differ in their last bits from run to run; what the
corners and the poses get of an equal image gradient does not.
"""

from __future__ import annotations

from torch import Tensor

from ...launch import launching
from . import triton_surface


def thickness(points: Tensor, faces: Tensor, shape: tuple[int, int], lines: int) -> Tensor:
    """[V, H, W] float64 of points [V, P, 3] `(column, row, depth)`; arguments as the package's function, checked."""
    with launching(points):
        return triton_surface.draw(points.contiguous(), faces.contiguous(), shape, lines)


def corner_shares(points: Tensor, faces: Tensor, gradient: Tensor, weights: Tensor) -> Tensor:
    """What each corner of each face gets of the image's gradient [V, H, W], views weighed by `weights` [V]: [F, 3]."""
    points, faces, gradient, weights = (a.contiguous() for a in (points, faces, gradient, weights))
    with launching(points):
        return triton_surface.shares(points, faces, gradient, weights)


def pose_gradients(points: Tensor, vertices: Tensor, faces: Tensor, gradient: Tensor) -> tuple[Tensor, Tensor]:
    """Gradients of rotations [V, 3, 3] and shifts [V, 2], of the image's [V, H, W]; float64, lengths in pixels."""
    points, vertices, faces, gradient = (a.contiguous() for a in (points, vertices, faces, gradient))
    with launching(points):
        sums = triton_surface.pose_sums(points, vertices, faces, gradient)
    return sums[:, :9].reshape(-1, 3, 3), -sums[:, 9:11]
