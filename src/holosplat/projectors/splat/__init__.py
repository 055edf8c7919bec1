"""Gaussians in parallel beams or cones: line integrals (`splat`) and samples on a voxel raster (`voxelise`).

A cloud of N Gaussians has, with every length in PIXELS (the caller scales from metres and back):

- centres [N, 3]: `(x, y, z)` in the object frame, whose origin is the centre of the field of view; - scales [N, 3]:
standard deviations along the Gaussian's own axes, above zero; - quaternions [N, 4]: `(w, x, y, z)`, of any length but
zero; they are normalised, and gradients account for it; - amplitudes [N, C], C = 1 or 2: signed peak values `a` of the
Gaussian `a exp(-½ (x-c)ᵀ Σ⁻¹ (x-c))`, whose covariance is `Σ = R_q diag(s²) R_qᵀ`.

Backends: `cpu` (C++, float32), `cuda` (Triton, float32, tensors on the GPU) and `reference` (plain torch, any float
type and device, slow), which is the specification of the others. All give gradients of the four arrays above, and of
the views' rotations, shifts and sources where those are tensors that require them.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from ...backends import implementation, interpreted
from ...checks import InputError, finite, require, shaped


def splat(
    centres: Tensor,
    scales: Tensor,
    quaternions: Tensor,
    amplitudes: Tensor,
    rotations: Tensor | np.ndarray,
    shifts: Tensor | np.ndarray,
    shape: tuple[int, int],
    *,
    pixels: Tensor | None = None,
    sources: Tensor | None = None,
    backend: str = "cpu",
    cutoff: float = 4.0,
    pixel_variance: float = 1 / 12,
    trusted: bool = False,
) -> Tensor:
    """Line integrals [V, C, H, W] of a Gaussian cloud along the beam (amplitude × pixels), for V views.

    The cloud is described at the top of this module. rotations [V, 3, 3]: `x_lab = R x_obj`, the beam along +z_lab;
    shifts [V, 2]: detector shifts `(sx, sy)` [px]. Pixel `(i, j)` of `shape = (H, W)` has its centre at
    `x = (j + ½ - W/2) + sx`, `y = (i + ½ - H/2) + sy`. A gradient of the rotations treats their nine numbers as free
    (in parallel beams the third row has gradient zero: it moves matter along them), and costs nothing where none is
    required.

    `pixels`: [V] float64, edges of the views' pixels in the unit of length, which is the pixel where there are none;
    they may want gradients. A view of pixels s is one of pixels 1 by the matrix `R / s`, which shrinks areas, and not
    the mass, by s².

    `sources`: [V] float64, distances R [px] of point sources, at `(0, 0, -R)` of the lab; pixels are at z = 0 (None:
    parallel beams). The perspective is affine about each Gaussian's centre (Zwicker et al. 2001), so that a Gaussian's
    image is wrong by about σ / R of its peak. What lies behind a source is not seen.

    `pixel_variance` [px²] is added to the projected covariance, mass conserved: the pixel's own, 1/12, stands
    for integration over its area (within 0.3 % for σ ≥ 1 px). The sum over pixels is the mass within 0.3 %
    for σ ≥ 0.5 px; thinner Gaussians keep it only on average over positions in the pixel (±7 % at 0.3 px).
    Each Gaussian adds to the pixels of the rectangle that holds its `cutoff`-σ ellipse, and to no other.
    `trusted`: arguments are taken as they are, and nothing is checked. Types, shapes and values must be right, and
    rotations and shifts float64 tensors on the cloud's device. For inner loops: a look at values waits for a GPU.
    Errors: `InputError` for input of the wrong shape, type or range; `RuntimeError` if the backend's library is
    missing.
    """
    run = implementation(__name__, backend).splat
    cloud = (centres, scales, quaternions, amplitudes)
    if not trusted:
        _check_cloud(backend, *cloud)
        _check_raster("detector shape", shape, "two positive counts (rows, columns)", 2)
        _check_spread(cutoff, "pixel_variance", pixel_variance)
        rotations, shifts = (array.to(centres.device) for array in _check_views(rotations, shifts))
        _check_lengths("pixels", "edges of pixels", pixels, rotations)
        _check_lengths("sources", "distances of sources", sources, rotations)
    spread = _counts(shape), float(cutoff), float(pixel_variance)
    factors = None
    if pixels is not None:
        rotations, shifts = rotations / pixels[:, None, None], shifts / pixels[:, None]  # type: ignore[operator]
        sources, factors = None if sources is None else sources / pixels, (pixels**-2)[:, None, None, None]
    if sources is not None:
        inclined = _obliquity(shifts, sources, shape)  # type: ignore[arg-type]
        factors = inclined if factors is None else factors * inclined
    lines = run(cloud, (rotations, shifts, None if sources is None else 1 / sources), *spread)
    return lines if factors is None else lines * factors.to(lines)


def _obliquity(shifts: Tensor, sources: Tensor, shape: tuple[int, int]) -> Tensor:
    """How much longer rays are than their depth, [V, 1, H, W], from sources [V] to the pixels."""
    y, x = (torch.arange(n, dtype=sources.dtype, device=sources.device) + (0.5 - n / 2) for n in shape)
    squares = (x + shifts[:, :1])[:, None] ** 2 + ((y + shifts[:, 1:]) ** 2)[:, :, None]
    return (1 + squares / sources[:, None, None] ** 2).sqrt()[:, None]


def voxelise(
    centres: Tensor,
    scales: Tensor,
    quaternions: Tensor,
    amplitudes: Tensor,
    shape: tuple[int, int, int],
    *,
    backend: str = "cpu",
    cutoff: float = 4.0,
    voxel_variance: float = 1 / 12,
    trusted: bool = False,
) -> Tensor:
    """A Gaussian cloud on a voxel raster, [C, Z, Y, X]: nearly its mean over each voxel.

    The cloud is described at the top of this module, with the voxel pitch as the pixel. Voxel `[z, y, x]` of
    `shape = (Z, Y, X)` has its centre at `(x + ½ - X/2, y + ½ - Y/2, z + ½ - Z/2)`. `voxel_variance` [voxel²]
    is added to the covariance as `pixel_variance` is in `splat`, with the mass conserved. Each Gaussian adds
    to the voxels of the cuboid that holds its `cutoff`-σ ellipsoid. `trusted` and errors: as `splat`.
    """
    run = implementation(__name__, backend).voxelise
    cloud = (centres, scales, quaternions, amplitudes)
    if not trusted:
        _check_cloud(backend, *cloud)
        _check_raster("volume shape", shape, "three positive counts (Z, Y, X)", 3)
        _check_spread(cutoff, "voxel_variance", voxel_variance)
    return run(cloud, _counts(shape), float(cutoff), float(voxel_variance))


def _check_cloud(backend: str, centres: Tensor, scales: Tensor, quaternions: Tensor, amplitudes: Tensor) -> None:
    """`InputError` unless the four arrays describe a cloud the backend can draw."""
    cloud = {"centres": centres, "scales": scales, "quaternions": quaternions, "amplitudes": amplitudes}
    for name, array in cloud.items():
        kind = type(array).__name__
        require(isinstance(array, Tensor), f"{name} must be a torch tensor, but it is a {kind}.")
    count = centres.shape[0] if centres.ndim else 0
    for (name, array), width in zip(cloud.items(), (3, 3, 4, None)):
        shaped(name, array, (count, width))  # type: ignore[arg-type]
        _check_type(backend, name, array, centres)
        finite(name, _numbers(array))
    channels = amplitudes.shape[1]
    require(channels in (1, 2), f"amplitudes must have 1 or 2 channels, but they have {channels}.")
    if count:
        smallest = float(_numbers(scales).min())
        require(smallest > 0, f"scales must be above zero, but the smallest is {smallest:g}; clamp them.")
        w, x, y, z = _numbers(quaternions).T
        shortest = float((w * w + x * x + y * y + z * z).min())
        require(shortest > 1e-30, "quaternions must not be zero, but one is; (1, 0, 0, 0) is no rotation.")


def _numbers(array: Tensor) -> np.ndarray:
    """The values of a tensor. The checks use numpy: torch's threads would spin where cores are few."""
    array = array.detach().cpu()
    return (array if array.dtype in (torch.float32, torch.float64) else array.double()).numpy()


def _check_type(backend: str, name: str, array: Tensor, centres: Tensor) -> None:
    held = f"{array.dtype} on {array.device}"
    require(array.is_floating_point(), f"{name} must hold real numbers, but they are {held}; use .float().")
    alike = array.dtype == centres.dtype and array.device == centres.device
    require(
        alike,
        f"{name} must have the type and device of centres, {centres.dtype} on {centres.device}, but they are {held}.",
    )
    if backend != "reference":
        place = "cuda" if backend == "cuda" and not interpreted() else "cpu"
        require(
            array.dtype == torch.float32 and array.device.type == place,
            f"{name} must be float32 on {place} for the {backend} backend, but they are {held}; "
            "convert them, or ask for backend='reference'.",
        )


def _check_views(rotations: Tensor | np.ndarray, shifts: Tensor | np.ndarray) -> tuple[Tensor, Tensor]:
    """Rotations [V, 3, 3] and shifts [V, 2] as float64 tensors, with gradients; `InputError` if they are no views."""
    rotations, shifts = torch.as_tensor(rotations), torch.as_tensor(shifts)
    turns, moves = (_numbers(array).astype(np.float64) for array in (rotations, shifts))
    finite("rotations", shaped("rotations", turns, (None, 3, 3)))
    finite("shifts", shaped("shifts", moves, (len(turns), 2)))
    proper = np.abs(turns @ turns.transpose(0, 2, 1) - np.eye(3)).max(initial=0) < 1e-4
    proper = bool(proper and np.all(np.linalg.det(turns) > 0))
    require(proper, "rotations must hold proper rotation matrices (R Rᵀ = 1, det R = 1).")
    return rotations.double(), shifts.double()


def _check_lengths(name: str, what: str, lengths: Tensor | None, rotations: Tensor) -> None:
    """`InputError` unless there is one length above zero for each view, or none at all."""
    if lengths is None:
        return
    good = lengths.dtype == torch.float64 and tuple(lengths.shape) == (len(rotations),)
    held = (lengths.dtype, tuple(lengths.shape))
    require(good, f"{name} must be float64, one for each of the {len(rotations)} views, but they are {held}.")
    require(bool((lengths > 0).all()), f"{name} must be {what} above zero, but one is not; correct it.")


def _check_raster(field: str, shape: tuple[int, ...], wanted: str, dimensions: int) -> None:
    counts = tuple(shape)
    if len(counts) != dimensions or any(n != int(n) or not 1 <= n < 2**24 for n in counts):
        raise InputError(f"{field} must be {wanted}, but it is {counts}.")


def _counts(shape: tuple[int, ...]) -> tuple[int, ...]:
    return tuple(int(n) for n in shape)


def _check_spread(cutoff: float, name: str, variance: float) -> None:
    require(0 < cutoff <= 10, f"cutoff must be above 0 and at most 10 standard deviations, but it is {cutoff}.")
    require(0 <= variance < math.inf, f"{name} must be a variance of zero or more, but it is {variance}.")
