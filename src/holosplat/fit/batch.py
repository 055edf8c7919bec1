"""What one step of a fit looks at."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class Batch:
    """The frames and the block of volume of one step.

    index: frames [K] int64, of one time or several; None for all of them in order
    middle: centre [3] `(x, y, z)` [m] of the block of volume, float64
    progress: share [] of the steps that are done
    volume: weight of the terms on the volume, 0 where this step does not look at it

    The tensors live on the fit's device, where a captured step reads them again.
    """

    index: Tensor | None
    middle: Tensor
    progress: Tensor
    volume: int
