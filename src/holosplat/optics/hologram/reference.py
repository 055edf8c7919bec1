"""The wave optics in plain torch: the specification of the fast twins, in any float type, on any device.

The wave behind the object `exp(-Σ (kβ + i kδ) T)` (Paganin 2006, eq. 2.39), less one, is propagated by its
transfer function (Goodman 2005, eq. 4-20, or 3-74 where that is not enough); its intensity is blurred and averaged
over pixels.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from torch import Tensor

from ..propagation import bin_pixels, blur, exit_wave_of, fresnel_propagate

if TYPE_CHECKING:
    from . import OpticalPath


def hologram(lines: Tensor, refraction: np.ndarray | Tensor, path: OpticalPath) -> Tensor:
    """Frames [V, h, w]; arguments as the package's `hologram`, already checked."""
    pairs = _of_channels(refraction, lines)
    phase = sum(k_delta * line for (k_delta, _), line in zip(pairs, lines.unbind(1)))
    loss = sum(k_beta * line for (_, k_beta), line in zip(pairs, lines.unbind(1)))
    assert isinstance(phase, Tensor)
    assert isinstance(loss, Tensor)
    wave = fresnel_propagate(exit_wave_of(loss, phase), path.transfer)
    contrast = 2 * wave.real + wave.real**2 + wave.imag**2
    if path.blur_rows is not None and path.blur_columns is not None:
        half = path.blur_columns[:, None, : contrast.shape[-1] // 2 + 1]
        contrast = blur(contrast, path.blur_rows[:, :, None] * half)
    (my, mx), (h, w), s = path.margin, path.shape, path.factor
    return 1 + bin_pixels(contrast[:, my : my + h * s, mx : mx + w * s], s)


def _of_channels(refraction: np.ndarray | Tensor, lines: Tensor) -> Any:
    """For each channel `(k δ, k β)`: numbers from [C, 2], or tensors [V, 1, 1] from [V, C, 2]."""
    if isinstance(refraction, np.ndarray):
        return refraction.tolist()
    return refraction.to(lines.dtype).permute(1, 2, 0)[..., None, None]
