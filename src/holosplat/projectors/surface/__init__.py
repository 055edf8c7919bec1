"""Thickness of deformable closed surfaces in beams and cones, with gradients of their vertices and of the poses.

Not the projector that simulations use (`projectors.mesh`), nor its arithmetic: there rays are cast through points,
here lines are integrated over pixels.

Forward: the thickness along a line of constant row is integrated exactly over each pixel it crosses, and averaged
over `lines` lines a pixel. Backward: for an image G of derivatives, `d/dv ∫ G(x, y) T(x, y) dx dy` is the integral
of `G λ_v n` over the surface, λ_v the vertex' barycentric hat and n the outward normal (Reynolds' transport theorem, or
Hadamard's formula: Delfour & Zolésio 2011, "Shapes and Geometries", chapter 9). It is finite where the surface is seen
edge-on, and the derivative of T is not. G is linear between pixels, so it is the derivative of the thickness
averaged under a hat of one pixel's reach: both agree to second order in the pixel. A pose moves the surface in the lab
frame, `p = R v - s`: its gradient is the same integral, over the motion that the pose gives each vertex.

In a cone, each view sees vertices where the source casts them on the plane through the object's origin, in the depth
that they have, and rays are longer than the depth that they cross (`projectors`). Faces stay flat there, which true
ones do not quite: a face that is d deep errs by d² / 4R at most, R the source's distance.

Backends: `cpu` (C++), `cuda` (Triton) and `reference` (plain torch), all in float64, where the vertices are.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ...backends import implementation
from ...checks import require
from .. import obliquity
from .reference import occupancy

__all__ = ["surface_occupancy", "surface_thickness"]

MOST_LINES = 1024
"""Rows integrated in a pixel, at most; four are exact to a thousandth."""


def surface_thickness(
    vertices: Tensor,
    faces: Tensor,
    rotations: Tensor,
    shifts: Tensor,
    shape: tuple[int, int],
    lines: int = 2,
    backend: str = "cpu",
    *,
    pixels: Tensor | None = None,
    sources: Tensor | None = None,
    trusted: bool = False,
) -> Tensor:
    """Line integrals [V, H, W] of one over the inside of closed surfaces, float64; lengths in PIXELS.

    vertices: [P, 3] float64 `(x, y, z)`, object frame; faces: [F, 3] int64, counter-clockwise seen from outside (a
    cavity's from within it); rotations [V, 3, 3], shifts [V, 2] `(sx, sy)`, float64: as for `projectors.splat`; lines:
    rows integrated in a pixel; pixels: [V] edges of the views' pixels in the unit of length, which is the pixel where
    there are none; sources: [V] distances of the views' sources, none for parallel beams; backend: `cpu`, `cuda` or
    `reference`; trusted: values are taken as they are, without waiting for a GPU. Overlapping bodies add up. Gradients:
    of the vertices, the rotations (all nine numbers, as of any matrix), the shifts, the edges and the sources; a
    gradient that is not required costs nothing. Errors: `InputError` for other shapes and types, and, unless trusted,
    vertices that are not finite and faces that name others.
    """
    _check(vertices, faces, trusted)
    require(1 <= lines <= MOST_LINES, f"lines must be from 1 to {MOST_LINES}, but it is {lines}.")
    views = len(shifts)
    good = rotations.shape == (views, 3, 3) and shifts.shape == (views, 2) and min(shape) >= 0
    good = good and all(a is None or a.shape == (views,) for a in (pixels, sources))
    edges = "" if pixels is None else f" and {tuple(pixels.shape)}"
    require(
        good,
        "rotations, shifts and pixels must have the shapes [V, 3, 3], [V, 2] and [V], but they are "
        f"{tuple(rotations.shape)}, {tuple(shifts.shape)}{edges}, on rasters {tuple(shape)}.",
    )
    if sources is not None:
        edges = [None] * views if pixels is None else list(pixels)
        poses = zip(rotations, shifts, edges, sources)
        seen = [_in_cone(vertices, faces, pose, shape, lines, backend) for pose in poses]
        return torch.stack(seen) if seen else vertices.new_zeros(0, *shape)
    poses, faces = (rotations.to(vertices), shifts.to(vertices)), faces.contiguous()
    if pixels is None:
        return _Thickness.apply(vertices, *poses, None, faces, shape, lines, backend)  # type: ignore[no-any-return]
    edges = pixels.to(vertices)  # R / s shortens lines, too
    scaled = (poses[0] / edges[:, None, None], poses[1] / edges[:, None])
    found = _Thickness.apply(vertices, *scaled, edges.detach(), faces, shape, lines, backend)
    assert isinstance(found, Tensor)
    return found * edges[:, None, None]


def _in_cone(
    vertices: Tensor,
    faces: Tensor,
    pose: tuple[Tensor, Tensor, Tensor | None, Tensor],
    shape: tuple[int, int],
    lines: int,
    backend: str,
) -> Tensor:
    """One view [H, W]; pose: its rotation, its shift, the edge of its pixels or None, and its source."""
    rotation, shift, source = (a.to(vertices) for a in (pose[0], pose[1], pose[3]))
    edge, upright = None if pose[2] is None else pose[2].to(vertices), torch.eye(3).to(vertices)[None]
    lab = vertices @ rotation.T
    seen = torch.cat((lab[:, :2] / (1 + lab[:, 2:] / source), lab[:, 2:]), 1)
    one = None if edge is None else edge[None]
    image = surface_thickness(seen, faces, upright, shift[None], shape, lines, backend, pixels=one, trusted=True)
    return image[0] * obliquity(shape, vertices.new_ones(()) if edge is None else edge, shift, source)


def surface_occupancy(vertices: Tensor, faces: Tensor, shape: tuple[int, int, int], lines: int = 4) -> Tensor:
    """The part [Z, Y, X] float64 of each voxel that closed surfaces enclose; lengths in VOXELS.

    vertices, faces: as above; voxel `[z, y, x]` has its centre at `(x, y, z)`. Surfaces are looked at along `lines`
    lines a voxel, in as many pieces. Errors: as above.
    """
    _check(vertices, faces, trusted=False)
    require(1 <= lines <= MOST_LINES, f"lines must be from 1 to {MOST_LINES}, but it is {lines}.")
    return occupancy(vertices, faces, shape, lines)


def _check(vertices: Tensor, faces: Tensor, trusted: bool) -> None:
    fits = vertices.ndim == 2 and vertices.shape[1] == 3 and vertices.dtype == torch.float64
    require(fits, f"vertices must be float64 [P, 3], but they are {vertices.dtype} {tuple(vertices.shape)}.")
    fits = faces.ndim == 2 and faces.shape[1] == 3 and faces.dtype == torch.int64
    require(fits, f"faces must be int64 [F, 3], but they are {faces.dtype} {tuple(faces.shape)}.")
    if trusted:
        return
    named = not faces.numel() or (int(faces.min()) >= 0 and int(faces.max()) < len(vertices))
    require(named, "faces must name existing vertices.")
    require(bool(vertices.detach().isfinite().all()), "vertices must be finite numbers.")


def _on_raster(vertices: Tensor, rotations: Tensor, shifts: Tensor, shape: tuple[int, int]) -> Tensor:
    """Points [V, P, 3] `(column, row, depth)` of vertices [P, 3]; pixel (i, j) has its centre at row i, column j."""
    h, w = shape
    (sx, sy), level = shifts.unbind(1), vertices.new_zeros(len(shifts))
    offset = torch.stack((0.5 * (w - 1) - sx, 0.5 * (h - 1) - sy, level), dim=1)[:, None]
    return torch.baddbmm(offset, vertices.expand(len(shifts), -1, -1), rotations.mT)  # one pass over the points


class _Thickness(torch.autograd.Function):
    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any,
        vertices: Tensor,
        rotations: Tensor,
        shifts: Tensor,
        edges: Tensor | None,
        faces: Tensor,
        shape: tuple[int, int],
        lines: int,
        backend: str,
    ) -> Tensor:
        points = _on_raster(vertices, rotations, shifts, shape)
        ctx.save_for_backward(vertices, faces, points, edges)
        ctx.backend = backend
        return implementation(__name__, backend).thickness(points, faces, shape, lines)  # type: ignore[no-any-return]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        vertices, faces, points, edges = ctx.saved_tensors
        gradient = gradient.to(vertices)
        kernels, of_vertices = implementation(__name__, ctx.backend), None
        if ctx.needs_input_grad[0]:  # a view of pixels s sees volumes s³ smaller
            weights = points.new_ones(len(points)) if edges is None else edges**-3
            of_vertices = _of_vertices(vertices, faces, kernels.corner_shares(points, faces, gradient, weights))
        poses: tuple[Tensor | None, Tensor | None] = (None, None)
        if any(ctx.needs_input_grad[1:3]):
            poses = kernels.pose_gradients(points, vertices, faces, gradient)
        return of_vertices, *poses, None, None, None, None, None


def _of_vertices(vertices: Tensor, faces: Tensor, shares: Tensor) -> Tensor:
    """The gradient [P, 3] of the vertices, of what the corners of the faces get [F, 3]."""
    a, b, c = vertices[faces].unbind(1)
    normals = torch.linalg.cross(b - a, c - a) / 6  # vector area, shared by the three points
    pulls = shares[..., None] * normals[:, None]
    return torch.zeros_like(vertices).index_add_(0, faces.reshape(-1), pulls.reshape(-1, 3))
