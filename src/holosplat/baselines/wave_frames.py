"""Frames of a projected thickness through the waves."""

from __future__ import annotations

from torch import Tensor
from torch.nn.functional import interpolate, pad

from ..matter import DeltaBeta
from ..model import Instrument
from ..volume import LineIntegrals


def frames_of(instrument: Instrument, lines: Tensor, material: DeltaBeta) -> Tensor:
    """Frames from thickness [V, H, W] in metres on the unpadded raster, or on a larger one about the same middle.

    Matter outside it counts as none.
    """
    rows, columns = ((n - seen) // 2 for n, seen in zip(instrument.views.shape, lines.shape[1:]))
    padded = pad(lines, (columns, columns, rows, rows))  # below 0 it cuts
    return instrument.frames(LineIntegrals(padded[:, None], ((material.delta, material.beta),)))


def refined(images: Tensor, factor: int) -> Tensor:
    """Images [V, H, W] on a raster `factor` times finer."""
    if factor == 1:
        return images
    return interpolate(images[None], scale_factor=factor, mode="bilinear", align_corners=False)[0]
