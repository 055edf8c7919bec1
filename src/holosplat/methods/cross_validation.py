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
    samples, backend = oversample or fringe_sampling(exposures), getattr(obj, "backend", "cpu")
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
        self.scan = scan
        self.measured = torch.from_numpy(scan.frames)
        self._correction = Correction(scan, material)
        even = scan.left(torch.ones(()))
        self.whole = self.of(even)
        """Mean square of all matter in the frames [m²]."""
        self.contrast = max(float(even.double().square().mean()), np.finfo(float).tiny)
        """Mean square of their contrast."""

    def predicted(self, obj: Object, oversample: int = 0) -> Tensor:
        """Frames [V, H, W] of `obj`, some views at a time to bound memory.

        oversample: wave samples a pixel (0: as the first fringe needs).
        """
        return predicted_frames(self.scan.exposures, obj, oversample)

    def of(self, residual: Tensor) -> float:
        """Mean square [m²] of the thickness that explains residuals [V, H, W] of intensity."""
        return float(self.matter(residual).square().mean())

    def matter(self, residual: Tensor) -> Tensor:
        """The thickness [V, H, W] [m] itself, float64; linear in the residuals."""
        return self._correction(residual).double()

    def share(self, obj: Object) -> float:
        """Root of the part of all matter that `obj` leaves unexplained: 0 for a perfect object, about 1 for none."""
        return self.shares(obj)[0]

    def shares(self, obj: Object, oversample: int = 0) -> tuple[float, float]:
        """The same of matter, and of the contrast of the frames. oversample: as for `predicted`."""
        matter, contrast = self.squares(self.scan.left(self.predicted(obj, oversample)))
        return math.sqrt(matter), math.sqrt(contrast)

    def beyond_noise(self, predicted: Tensor, noise: NoiseModel) -> float:
        """Root of the part of all matter that predicted frames [V, H, W] leave unexplained beyond `noise`; 0 where
        that may hide all of it, by `HIDDEN` standard deviations."""
        draws = torch.tensor([self.of(noise.drawn(seed)) for seed in range(DRAWS)], dtype=torch.float64)
        left = (self.of(self.scan.left(predicted)) - float(draws.mean())) / max(self.whole, np.finfo(float).tiny)
        deviation = float(draws.std(correction=0)) / max(self.whole, np.finfo(float).tiny)
        return math.sqrt(left) if left > HIDDEN * deviation else 0.0

    def squares(self, residual: Tensor) -> tuple[float, float]:
        """Squares of the parts of all matter, and of the contrast, that residuals [V, H, W] of intensity stand for."""
        intensity = float(residual.double().square().mean())
        return self.of(residual) / max(self.whole, np.finfo(float).tiny), intensity / self.contrast
