"""Frames of a projected thickness through the waves."""

from __future__ import annotations

from torch import Tensor
from torch.nn.functional import interpolate, pad

from ..matter import DeltaBeta
from ..model import Instrument
from ..volume import LineIntegrals


def frames_of(instrument: Instrument, lines: Tensor, material: DeltaBeta) -> Tensor:
    """Frames from thickness [V, H, W] in metres on the unpadded raster, or on a taller one about the same middle.

    Matter outside it counts as none.
    """
    mx, s = instrument.margin[1], instrument.oversample
    rows = (instrument.views.shape[0] - lines.shape[1]) // 2
    padded = pad(lines, (mx * s, mx * s, rows, rows))
    return instrument.frames(LineIntegrals(padded[:, None], ((material.delta, material.beta),)))


def refined(images: Tensor, factor: int) -> Tensor:
    """Images [V, H, W] on a raster `factor` times finer."""
    if factor == 1:
        return images
    return interpolate(images[None], scale_factor=factor, mode="bilinear", align_corners=False)[0]
