"""Photographs by emission and absorption, front to back: what an ordinary camera would see of opaque, shining matter.

No waves: the opponents of the benchmark take holograms for such photographs. The camera looks along the beam, so that
the front is where the beam comes from, and all rays are parallel to it. Behind everything is an evenly lit screen of
intensity 1, as a frame without matter is. Plain torch in any float type, with gradients.
"""

from __future__ import annotations

import torch
from torch import Tensor

from holosplat.projectors.splat.reference import boxes, pairs, rotation_matrices

DILATION = 0.3
"""Variance [pixels²] that is added to every projected Gaussian, its peak kept, so that none falls between pixels (as in
the published program of Kerbl et al. 2023)."""
LEAST_OPACITY, MOST_OPACITY = 1 / 255, 0.99
"""What is less opaque at a pixel is left out there, and nothing is more opaque (Kerbl et al. 2023, appendix C)."""


def composite(thickness: Tensor, greys: Tensor, pixel: Tensor, count: int) -> Tensor:
    """Intensities [count] of pixels `I = Σ T_i (1 - exp(-τ_i)) g_i + T_end`, `T_i = exp(-Σ_{j<i} τ_j)`.

    The quadrature of Max (1995), as Mildenhall et al. (2020, eq. 3) have it. thickness [P]: optical thickness τ, zero
    or more; greys [P]: what shines from there; pixel [P]: whose, ascending, and those of a pixel from front to back.
    """
    summed = thickness.double().cumsum(0)  # over all pixels: single precision would lose the last ones
    before = summed - thickness
    first = torch.searchsorted(pixel, torch.arange(count, device=pixel.device))
    offset = torch.cat([before, before.new_zeros(1)])[first]
    seen = torch.exp(offset[pixel] - before).to(thickness)
    total = thickness.new_zeros(count).index_add(0, pixel, thickness)
    return torch.exp(-total).index_add(0, pixel, -seen * torch.expm1(-thickness) * greys)


def photograph(
    centres: Tensor, scales: Tensor, quaternions: Tensor, values: Tensor, matrix: Tensor, shift: Tensor, shape: tuple
) -> Tensor:
    """The photograph [H, W] of Gaussians, one after another by the depth of their centres (Kerbl et al. 2023, eq. 3).

    centres, scales [N, 3], quaternions [N, 4] as for `splat`, in pixels; values [N, 2]: opacity in [0, 1) at the middle
    of a Gaussian, from wherever it is seen, and its grey value. matrix [3, 3], shift [2]: of the view, as for `splat`.
    """
    turn = matrix.to(centres)
    lab = centres @ turn.mT
    order = lab[:, 2].detach().argsort(stable=True)
    axes = turn[:2] @ (rotation_matrices(quaternions) * scales[:, None])[order]
    mean, covariance = lab[order, :2] - shift.to(centres), axes @ axes.mT + DILATION * torch.eye(2).to(centres)
    opacity, grey = values[order].unbind(1)
    with torch.no_grad():
        reach = (2 * (opacity / LEAST_OPACITY).clamp_min(1).log()).sqrt()[:, None]
        low, high = boxes(mean, covariance, shape, reach, 0.0)
        owner, pixel, _ = pairs(mean, low, high, shape)
        pixel, sorting = pixel.sort(stable=True)
        owner = owner[sorting]
        column, row = (
            (n + 0.5 - 0.5 * m).to(mean) for n, m in ((pixel % shape[1], shape[1]), (pixel // shape[1], shape[0]))
        )
    conic = torch.linalg.inv(covariance)
    each = torch.stack((*mean.unbind(1), conic[:, 0, 0], conic[:, 0, 1], conic[:, 1, 1], opacity, grey))
    mx, my, xx, xy, yy, opacity, grey = each.index_select(1, owner)
    x, y = column - mx, row - my
    alpha = (opacity * torch.exp(-0.5 * (xx * x * x + yy * y * y) - xy * x * y)).clamp_max(MOST_OPACITY)
    alpha = torch.where(alpha < LEAST_OPACITY, 0.0, alpha)
    return composite(-torch.log1p(-alpha), grey, pixel, shape[0] * shape[1]).reshape(shape)
