"""Splat and voxeliser in plain torch: the specification of the fast twins, in any float type, on any device.

Formulas. The 2D covariance of a projected Gaussian is the upper-left block of the 3D one in the lab frame,
exactly so in parallel beams (Zwicker et al. 2001, "EWA volume splatting", whose Jacobian is the identity there;
in a cone it is that of the perspective in the Gaussian's centre). Its line integral is the 3D mass
`(2π)^{3/2} s₁s₂s₃ a`, times what the perspective makes of areas, spread as a normalised 2D Gaussian.
Integration over a pixel is approximated by adding the pixel's variance to the covariance, mass conserved.

Every Gaussian is drawn on the integer box that holds its cutoff ellipse. The box is found in float64 whatever
the input's type, so that twins of lower precision draw the very same pixels; boxes carry no gradient.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor


def splat(
    cloud: Sequence[Tensor], poses: Sequence[Tensor | None], shape: tuple[int, ...], cutoff: float, variance: float
) -> Tensor:
    """Line integrals [V, C, H, W]; arguments and units as the package's `splat`, already checked.

    poses: with curvatures [V], one over the distances of sources (None: parallel beams); integrals along depth, not
    along rays.
    """
    (centres, scales, quaternions, amplitudes), (rotations, shifts, curvatures) = cloud, poses
    assert rotations is not None
    assert shifts is not None
    mass = (2 * math.pi) ** 1.5 * scales.prod(1, keepdim=True) * amplitudes
    images = [amplitudes.new_zeros((0, amplitudes.shape[1], *shape))]
    bent = [None] * len(rotations) if curvatures is None else curvatures
    for pose in zip(rotations, shifts, bent):
        mean, covariance, area = _projected(centres, scales, quaternions, *pose)
        covariance = covariance + variance * torch.eye(2).to(covariance)
        with torch.no_grad():
            exact = _projected(centres.double(), scales.double(), quaternions.double(), *pose)
            low, high = boxes(*exact[:2], shape, cutoff, variance)
        peak = area[:, None] * mass / (2 * math.pi * torch.linalg.det(covariance).sqrt()[:, None])
        images.append(_draw(mean, covariance, peak, low, high, shape)[None])
    return torch.cat(images)


def voxelise(cloud: Sequence[Tensor], shape: tuple[int, ...], cutoff: float, variance: float) -> Tensor:
    """Samples [C, Z, Y, X]; arguments and units as the package's `voxelise`, already checked."""
    centres, scales, quaternions, amplitudes = cloud
    axes = rotation_matrices(quaternions) * scales[:, None]
    covariance = axes @ axes.mT + variance * torch.eye(3).to(axes)
    with torch.no_grad():
        exact = rotation_matrices(quaternions.double()) * scales.double()[:, None]
        low, high = boxes(centres.double(), exact @ exact.mT, shape, cutoff, variance)
    # sqrt(det Σ) is the product of the scales: a determinant would lose thin Gaussians to rounding.
    peak = amplitudes * (scales.prod(1) / torch.linalg.det(covariance).sqrt())[:, None]
    return _draw(centres, covariance, peak, low, high, shape)


def rotation_matrices(quaternions: Tensor) -> Tensor:
    """Rotation matrices [N, 3, 3] of quaternions [N, 4] `(w, x, y, z)` of any length but zero."""
    w, x, y, z = (quaternions / quaternions.norm(dim=1, keepdim=True)).unbind(1)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def _projected(
    centres: Tensor,
    scales: Tensor,
    quaternions: Tensor,
    rotation: Tensor,
    shift: Tensor,
    curvature: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Means [N, 2] `(x, y)` from the detector's centre, covariances [N, 2, 2] in one view [px, px²], and what the
    perspective makes of a unit of area [N]: `m²`, with `m = 1 / (1 + z κ)`; zero behind the source.

    With `(u, v) = m (R₀ c, R₁ c)`, the map about the centre is `m (R₀ - κ u R₂)` and `m (R₁ - κ v R₂)`.
    """
    across, area = rotation[:2].to(centres).expand(len(centres), 2, 3), torch.ones_like(centres[:, 0])
    seen = centres @ rotation[:2].to(centres).mT
    if curvature is not None:
        beam = rotation[2].to(centres)
        depth = 1 + centres @ beam * curvature.to(centres)
        scale = torch.where(depth > 0, 1 / depth.where(depth > 0, 1.0), 0.0)
        seen, area = seen * scale[:, None], scale**2
        across = scale[:, None, None] * (across - curvature.to(centres) * seen[:, :, None] * beam)
    axes = across @ (rotation_matrices(quaternions) * scales[:, None])
    return seen - shift.to(centres), axes @ axes.mT, area


def boxes(
    mean: Tensor, covariance: Tensor, shape: tuple[int, ...], cutoff: float | Tensor, variance: float
) -> tuple[Tensor, Tensor]:
    """First and last pixel [N, D], as `(x, y[, z])`, of the boxes of the cutoff ellipses, cut to the raster.

    A box has the pixels whose centres lie, along every dimension d, within `cutoff · sqrt(Σ_dd + variance)`
    of the mean; cutoff: one, or [N, 1]. An empty box has its last pixel before its first.
    """
    counts = torch.tensor(shape[::-1]).to(mean)
    middle = mean + counts / 2 - 0.5
    radius = cutoff * (covariance.diagonal(dim1=1, dim2=2) + variance).sqrt()
    low = (middle - radius).ceil().clamp(min=0).minimum(counts)
    high = (middle + radius).floor().clamp(min=-1).minimum(counts - 1)
    return low.long(), high.long()


def _draw(mean: Tensor, covariance: Tensor, peak: Tensor, low: Tensor, high: Tensor, shape: tuple[int, ...]) -> Tensor:
    """The sum [C, *shape] of Gaussians of peak [N, C] on their boxes, by a list of (Gaussian, pixel)."""
    owner, address, offset = pairs(mean, low, high, shape)
    conic = torch.linalg.inv(covariance)
    square = torch.einsum("pi,pij,pj->p", offset, conic[owner], offset)
    values = peak[owner] * torch.exp(-0.5 * square)[:, None]
    image = peak.new_zeros((math.prod(shape), peak.shape[1])).index_add(0, address, values)
    return image.T.reshape(peak.shape[1], *shape)


def pairs(mean: Tensor, low: Tensor, high: Tensor, shape: tuple[int, ...]) -> tuple[Tensor, Tensor, Tensor]:
    """What boxes from pixel `low` to `high` [N, D] hold: the Gaussian [P], the pixel's place in the flat raster [P] and
    its distance [P, D] from the Gaussian's mean, one Gaussian after another."""
    extent = (high - low + 1).clamp(min=0)
    counts = extent.prod(1)
    owner = torch.arange(len(mean), device=mean.device).repeat_interleave(counts)
    rest = torch.arange(int(counts.sum()), device=mean.device) - (counts.cumsum(0) - counts)[owner]
    address, stride, offsets = torch.zeros_like(rest), 1, []
    for axis, count in enumerate(shape[::-1]):
        length = extent[owner, axis]
        index = low[owner, axis] + rest % length
        rest = rest // length
        address, stride = address + index * stride, stride * count
        offsets.append(index.to(mean) + (0.5 - count / 2) - mean[owner, axis])
    return owner, address, torch.stack(offsets, 1)
