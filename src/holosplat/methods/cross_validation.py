"""Frames of objects, and what of the matter is missing from them."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from ..baselines.holographic_tv import Correction
from ..matter import DeltaBeta
from ..memory import memory_kept
from ..model import Instrument, Model
from ..optics.noise_model import NoiseModel
from ..optics.sampling import alike, fringe_sampling
from ..representations import Stored
from ..scan import Exposures, Scan
from ..volume import Object

DRAWS = 16
"""Of the noise, for what it leaves of the matter: a standard deviation by so many is right to a sixth."""
HIDDEN = 2.0
"""Standard deviations of what noise leaves of the matter that it may hide."""


def predicted_frames(exposures: Exposures, obj: Object, oversample: int = 0) -> Tensor:
    """Frames [V, H, W] of `obj`, some views at a time to bound memory.

    oversample: wave samples a pixel (0: as the first fringe needs).
    """
    samples, backend = oversample or fringe_sampling(exposures), obj.backend if isinstance(obj, Stored) else "cpu"
    frames = torch.empty(len(exposures), *exposures.views.shape)
    with torch.no_grad(), memory_kept():
        for views in alike(exposures, samples):
            instrument = Instrument(exposures[views], samples, backend=backend)
            frames[torch.from_numpy(views)] = Model(obj, instrument).frames().cpu()
    return frames


class MissingMatter:
    """What is missing from the frames of a scan, as thickness of a material: the judge of whole volumes.

    A residual of intensity is turned into the thickness that would explain it, by Wiener's inverse of each view for
    its noise (`Correction`). So low frequencies, which hardly change a hologram, count by the matter that they stand
    for, and those that noise hides do not count at all.
    """

    def __init__(self, scan: Scan, material: DeltaBeta) -> None:
        self.scan, self._correction = scan, Correction(scan, material)
        self.whole = max(self.of(scan.left(torch.ones(()))), np.finfo(float).tiny)
        """Mean square of all matter in the frames [m²]."""

    def of(self, residual: Tensor) -> float:
        """Mean square [m²] of the thickness that explains residuals [V, H, W] of intensity."""
        return float(self._correction(residual).double().square().mean())

    def share(self, predicted: Tensor) -> float:
        """Root of the part of all matter that predicted frames [V, H, W] leave unexplained: 0 for those of a perfect
        object, about 1 for even light."""
        return math.sqrt(self.of(self.scan.left(predicted)) / self.whole)

    def beyond_noise(self, predicted: Tensor, noise: NoiseModel) -> float:
        """Root of the part of all matter that predicted frames [V, H, W] leave unexplained beyond `noise`; 0 where
        that may hide all of it, by `HIDDEN` standard deviations."""
        draws = torch.tensor([self.of(noise.drawn(seed)) for seed in range(DRAWS)], dtype=torch.float64)
        left = (self.of(self.scan.left(predicted)) - float(draws.mean())) / self.whole
        deviation = float(draws.std(correction=0)) / self.whole
        return math.sqrt(left) if left > HIDDEN * deviation else 0.0
