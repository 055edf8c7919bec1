"""Light in doubt taken out of a misfit: a few unknowns of each frame, over which its likelihood is integrated."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from ..optics.modes import cosines


class LightApart:
    """The part of images over their noise that light in doubt does not explain, exact for small changes of it.

    Light `1 + M c`, c ~ N(0, C), changes amplitudes by `B c = ½ √I₀ M c`, so that their errors have the covariance
    `P + B C Bᵀ`, of which the inverse is `P⁻¹ - P⁻¹ B R (1 + Rᵀ Bᵀ P⁻¹ B R)⁻¹ Rᵀ Bᵀ P⁻¹`, R Rᵀ = C (Woodbury 1950).

    amplitudes: √I₀ [V, H, W]; covariances: C [V, K, K] of the coefficients of `smooth_modes`; over_noise: P⁻¹ of images
    [V, H, W].
    """

    def __init__(self, amplitudes: Tensor, covariances: Tensor, over_noise: Callable[[Tensor], Tensor]) -> None:
        order = math.isqrt(covariances.shape[1]) - 1
        self._half, self._over_noise = 0.5 * amplitudes, over_noise
        on = amplitudes.device
        self._rows, self._columns = (cosines(n, order, on).float() for n in amplitudes.shape[1:])
        modes = (self._rows[:, None, :, None] * self._columns[None, :, None, :]).flatten(0, 1)
        products = [self._modes_in(over_noise(self._half * mode)) for mode in modes]
        normal = torch.stack(products, dim=2).double().cpu()  # a small system of each view
        strength, vectors = torch.linalg.eigh(covariances)
        roots = vectors * strength.clamp_min(0).sqrt()[:, None]
        inner = roots.mT @ normal @ roots + torch.eye(len(modes), dtype=torch.float64)
        self._gain = (roots @ torch.linalg.solve(0.5 * (inner + inner.mT), roots.mT)).float().to(on)

    def __call__(self, weighted: Tensor) -> Tensor:
        """Images [V, H, W] over their noise, without what light explains."""
        said = torch.einsum("vkl,vl->vk", self._gain, self._modes_in(weighted))
        light = said.unflatten(1, (len(self._rows), len(self._columns)))
        return weighted - self._over_noise(self._half * (self._rows.T @ light @ self._columns))

    def _modes_in(self, images: Tensor) -> Tensor:
        """Bᵀ of images [V, H, W], [V, K]."""
        return (self._rows @ (self._half * images) @ self._columns.T).flatten(1)
