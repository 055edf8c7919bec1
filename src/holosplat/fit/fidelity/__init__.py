"""How alike predicted and measured frames are: L1 and SSIM of each view, with the gradient of the prediction.

Frames are compared after the affine map that takes `low` to 0 and `low + span` to 1. Local moments are taken under an
11 × 11 Gaussian window of σ = 1.5 pixels (Wang et al. 2004), wholly inside: h = H - 10, w = W - 10. A side shorter
than 11 pixels has one window, of its length.

Backends: `cpu` (C++) and `cuda` (Triton), both in float32, and `reference` (plain torch, any float type and device),
which is the specification of the others. Each has `statistics(frames, low, span)` and
`l1_and_ssim(predicted, frames, statistics, low, span)`.
"""

from __future__ import annotations

import copy
import math

import torch
from torch import Tensor

from ...backends import implementation
from ...checks import require


class Target:
    """Measured frames, and what of them every comparison needs.

    frames: [V, H, W], of any unit; low, span: as above; backend: `cpu`, `cuda` or `reference`;
    statistics: local mean and local variance of the mapped frames, [V, 2, h, w].
    Errors: `InputError` if the frames or the map are of no use to the backend.
    """

    def __init__(self, frames: Tensor, low: float, span: float, backend: str = "cpu") -> None:
        require(frames.ndim == 3, f"frames must have the shape [V, H, W], but they have {tuple(frames.shape)}.")
        require(frames.is_floating_point(), f"frames must hold real numbers, but they are {frames.dtype}.")
        require(
            backend == "reference" or frames.dtype == torch.float32,
            f"frames must be float32 for the {backend} backend, but they are {frames.dtype}; use .float().",
        )
        require(0 < span < math.inf, f"span must be positive, but it is {span}.")
        self.frames, self.low, self.span, self.backend = frames.contiguous(), float(low), float(span), backend
        self._compute = implementation(__name__, backend).statistics
        self._statistics: Tensor | None = None

    @property
    def statistics(self) -> Tensor:
        """Local mean and variance, [V, 2, h, w]; computed when they are first needed, then kept."""
        found = self._statistics
        if found is None:
            found = self._statistics = self._compute(self.frames, self.low, self.span)
        return found

    def __len__(self) -> int:
        """The number of views."""
        return len(self.frames)

    def __getitem__(self, index: Tensor) -> Target:
        """The views of `index` [K] int64, on the frames' device. Waits for no GPU."""
        part = copy.copy(self)
        part.frames = self.frames.index_select(0, index)
        part._statistics = None if self._statistics is None else self._statistics.index_select(0, index)
        return part


def l1_and_ssim(predicted: Tensor, target: Target) -> tuple[Tensor, Tensor]:
    """Mean absolute difference [V], and 1 - mean SSIM [V], of `predicted` [V, H, W] and the target's frames.

    Differentiable in `predicted`, once. Errors: `InputError` if shapes or types differ.
    """
    frames = target.frames
    require(
        (predicted.shape, predicted.dtype, predicted.device) == (frames.shape, frames.dtype, frames.device),
        f"predicted frames must be like the target's, {tuple(frames.shape)} {frames.dtype} on {frames.device}, "
        f"but they are {tuple(predicted.shape)} {predicted.dtype} on {predicted.device}.",
    )
    compare = implementation(__name__, target.backend).l1_and_ssim
    return compare(predicted, frames, target.statistics, target.low, target.span)
