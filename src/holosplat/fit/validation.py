"""Training frames that are set aside: they choose the best state of a fit, and stop it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from ..checks import require
from ..model import Instrument, Model
from ..scan import Scan
from .terms import comparisons


class Judge:
    """Scores a model on frames that the fit does not see. low, span: the affine map that takes frames to [0, 1]."""

    COLUMNS = ("val_l1", "val_ssim", "val_frcm")

    def __init__(self, frames: Scan, instrument: Instrument, low: float, span: float) -> None:
        """instrument: of the exposures of `frames`."""
        self.scan, self._instrument, self._low, self._span = frames, instrument, low, span

    def __call__(self, model: Model) -> tuple[float, dict[str, float]]:
        """The score, smaller is better, and the columns of metrics.csv.

        It is that of SSIM and FRCM, not of L1, which prefers a blurred object to one with its fringes misplaced.
        """
        with torch.no_grad():
            predicted = replace(model, instrument=self._instrument, alignment=None, light=None).frames().cpu()
        a, b = ((f - self._low) / self._span for f in (predicted, torch.from_numpy(self.scan.frames)))
        ssim, frcm = (1 - float(term(a, b).mean()) for term in (comparisons.one_minus_ssim, comparisons.one_minus_frcm))
        columns = {"val_l1": float(comparisons.l1(a, b).mean()), "val_ssim": ssim, "val_frcm": frcm}
        return 1 - 0.5 * (ssim + frcm), columns


def split_validation(train: Scan, count: int) -> tuple[Scan, Scan]:
    """Training frames without, and only, `count` evenly spread validation frames; `InputError` if none is left."""
    require(
        count < len(train),
        f"validation_views must leave a training frame: {count} of {len(train)} are asked for.",
    )
    chosen = set_aside(len(train), count)
    return train[np.flatnonzero(~chosen)], train[np.flatnonzero(chosen)]


def set_aside(frames: int, count: int) -> np.ndarray:
    """Which of so many training frames `split_validation` sets aside, [V] bool."""
    chosen = np.zeros(frames, dtype=bool)
    if count > 0:
        chosen[((np.arange(count) + 0.5) * frames / count).astype(int)] = True
    return chosen
