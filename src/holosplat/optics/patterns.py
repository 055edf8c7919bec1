"""Patterns of light: smooth modes, their coefficients, and the fixed pattern that frames have beside their matter."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ..checks import require


def smooth_modes(shape: tuple[int, int], order: int, device: torch.device | str = "cpu") -> Tensor:
    """Products of cosines [K, h, w] up to `order` half waves along each side, `(order + 1)²` of them, float32.

    The first is constant one; they are those of the discrete cosine transform, of rms one.
    """
    require(order >= 0, f"the order of smooth modes must be 0 or more, but it is {order}.")
    rows, columns = (cosines(n, order, device) for n in shape)
    modes = rows[:, None, :, None] * columns[None, :, None, :]
    return modes.reshape(-1, *shape).float()


def half_waves(order: int) -> Tensor:
    """How many half waves each of `smooth_modes` has across a frame, [K], the root of the squares of both sides."""
    count = torch.arange(order + 1, dtype=torch.float64)
    return (count[:, None].square() + count.square()).sqrt().flatten()


def cosines(count: int, order: int, device: torch.device | str) -> Tensor:
    """Cosines [order + 1, count] of 0 to `order` half waves along `count` pixels, of rms one, float64."""
    place = (torch.arange(count, dtype=torch.float64, device=device) + 0.5) / count
    waves = torch.cos(torch.pi * torch.arange(order + 1, dtype=torch.float64, device=device)[:, None] * place)
    return waves / waves.square().mean(dim=1, keepdim=True).sqrt().clamp_min(1e-12)


DARKEST = 0.01
"""Relative intensity below which a pixel counts as so bright: its logarithm has no meaning."""


def fixed_pattern(frames: Tensor, predicted: Tensor, axis: float) -> Tensor:
    """The pattern [H, W], float64, by frames [V, H, W] over those `predicted`; one where frames have nothing in common.
    Pixels that are NaN have no weight. axis: the column of the rotation axis, counted from 0.

    The logarithms of frames over predictions are the pattern's and what each frame has alone, and a Wiener filter of
    single pixels takes their mean for the pattern as far as chance allows. A pattern knows nothing of matter; errors of
    the volume grow with its shadows, of which those of matter near the axis are alike in all frames. They are even in
    the distance from the axis as far as that matter is, while half of a pattern's power is odd. So the odd part o of
    the mean gives the power c of the pattern beside v of chance, that of a frame alone over V, apart from what goes
    with the square of the shadow d that all frames have in common: `2 <o²> = c + v + s d²`. The even part e has at
    least as much power, `2 <e²> = c' + s' d²`, of which c is the pattern's:
    `p = o c / (c + v + s d²) + e c / (c' + s' d²)`. Where no pixel has a mirror image, nothing tells them apart, and
    there is no pattern.
    """
    shadows = _logarithms(predicted)
    left, count = _logarithms(frames) - shadows, len(frames)
    left = left - left.nanmean()
    total, mean = float(left.square().nanmean()), left.nanmean(dim=0).nan_to_num()
    chance = (total - float(mean.square().mean())) / max(count - 1, 1)
    shadow = shadows.nanmean(dim=0).nan_to_num().square()
    columns = round(2 * axis) - torch.arange(mean.shape[1])
    inside = (columns >= 0) & (columns < mean.shape[1])
    if count < 2 or not inside.any():
        return torch.ones_like(mean)
    odd, even = torch.zeros_like(mean), mean.clone()
    odd[:, inside] = 0.5 * (mean[:, inside] - mean[:, columns[inside]])
    even[:, inside] = 0.5 * (mean[:, inside] + mean[:, columns[inside]])
    powers = [_powers(2 * part[:, inside].square().numpy(), shadow[:, inside].numpy()) for part in (odd, even)]
    common = powers[0][0] - chance
    if common <= 0:
        return torch.ones_like(mean)
    of_odd, of_even = (constant + slope * shadow for constant, slope in powers)
    return (common * (odd / of_odd + even / of_even.maximum(of_odd))).exp()


ROUNDS = 10
"""Rounds of weights in `_powers`, which converge in fewer."""


def _powers(found: np.ndarray, shadow: np.ndarray) -> tuple[float, float]:
    """a, b ≥ 0 of the powers `found ≈ a + b shadow` [H, W], the likeliest of squares of normal numbers: weighted least
    squares, with weights of one over the variance, which goes as the square of the mean (Nelder & Wedderburn 1972)."""
    from scipy.optimize import nnls  # which takes long to load

    columns, values = np.stack([np.ones(shadow.size), shadow.ravel()], axis=1), found.ravel()
    at = np.array([values.mean(), 0.0])
    for _ in range(ROUNDS if values.any() else 0):
        weight = 1 / np.maximum(columns @ at, 1e-6 * values.mean())
        at, _ = nnls(columns * weight[:, None], values * weight)
    return float(at[0]), float(at[1])


def mean_light(frames: Tensor, predicted: Tensor, order: int) -> Tensor:
    """The geometric mean [H, W], float64, of frames [V, H, W] over those `predicted`: of up to `order` half waves, with
    its mean taken to be right, or any pattern (0)."""
    mean = (_logarithms(frames) - _logarithms(predicted)).nanmean(dim=0).nan_to_num()
    if order:
        modes = smooth_modes((mean.shape[0], mean.shape[1]), order)[1:].flatten(1).double()
        mean = (torch.linalg.lstsq(modes.T, mean.flatten()[:, None]).solution[:, 0] @ modes).reshape(mean.shape)
    return mean.exp()


def _logarithms(frames: Tensor) -> Tensor:
    return frames.double().clamp_min(DARKEST).log()


def sums(values: Tensor, seen: Tensor, modes: Tensor) -> tuple[Tensor, Tensor]:
    """Of values [V, P], where they are seen [V, P], and modes [K, P]: their products [V, K, K] and [V, K]."""
    normal = torch.stack([(modes * one) @ modes.T for one in seen])
    return normal, (values.nan_to_num() * seen) @ modes.T


def posterior(normal: Tensor, right: Tensor, variances: Tensor, powers: Tensor) -> tuple[Tensor, Tensor]:
    """Mean [V, K] and covariance [V, K, K] of coefficients whose prior has `variances` [K]."""
    covariance = posterior_covariance(normal, variances, powers)
    return torch.einsum("vkl,vl->vk", covariance, right / powers[:, None]), covariance


def posterior_covariance(normal: Tensor, variances: Tensor, powers: Tensor) -> Tensor:
    """`(N/p + T⁻¹)⁻¹ = S (S N S/p + 1)⁻¹ S` [V, K, K], S² = T: of normal equations N [V, K, K], variances T [K] and
    noise of power p [V]; so it is exact for any T."""
    scale = variances.sqrt()
    inner = normal * scale[:, None] * scale / powers[:, None, None] + torch.eye(len(scale), dtype=torch.float64)
    return torch.linalg.inv(inner) * scale[:, None] * scale
