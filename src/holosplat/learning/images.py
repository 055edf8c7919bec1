"""What a network sees of a scan: the contrast of its frames, the thickness retrieved from each, and their noise."""

from __future__ import annotations

import torch
from torch import Tensor

from ..materials import DeltaBeta
from ..optics.retrieval import Tikhonov, tikhonov
from ..scan import Exposures

RETRIEVAL = Tikhonov(iterations=20)
"""Of each frame by itself: a third of the steps of the other starts, as a network mends what is left."""
TYPICAL = (0.5, 0.25, 0.5)
"""Factors of the channels, which then are of order one: of the contrast over its root mean square, of the thickness in
pixels, and of the noise over the contrast."""


def retrieved_thickness(frames: Tensor, exposures: Exposures, material: DeltaBeta) -> Tensor:
    """Projected thickness [V, H, W] [m] of `material` in relative frames [V, H, W], each by itself; errors: those of
    `tikhonov`."""
    return tikhonov(frames, exposures, *material, options=RETRIEVAL)


def images(contrast: Tensor, thickness: Tensor, noise: Tensor) -> Tensor:
    """The network's images [V, 3, H, W] float32 of views.

    contrast: [V, H, W], relative intensity less one; thickness: [V, H, W], retrieved, in pixels; noise: [V], standard
    deviation of the noise of the contrast.
    """
    rms = contrast.float().square().mean().sqrt().clamp_min(torch.finfo(torch.float16).tiny)
    level = (noise.float() / rms)[:, None, None].expand(contrast.shape)
    of_contrast, of_thickness, of_noise = TYPICAL
    return torch.stack([of_contrast * contrast / rms, of_thickness * thickness, of_noise * level], 1).float()
