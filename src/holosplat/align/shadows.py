"""Frames as images that are linear in what the beam passed: what moments and sinograms are taken of."""

from __future__ import annotations

import torch

from ..optics.background import Light, LightOptions
from ..optics.retrieval import paganin
from ..scan import Scan

DARKEST = 1e-3
"""Intensity [relative] below which a logarithm is that of noise; it is taken for this much."""
EVEN_OR_NOT = LightOptions()
"""Even, unless the air of the frames shows otherwise."""
TRIAL_DELTA = 1e-6
"""Any δ will do: shadows are counted in units of their own."""


def shadows(scan: Scan, ratio: float | None = None, light: LightOptions = EVEN_OR_NOT) -> torch.Tensor:
    """Images [V, H, W], float64, of what each frame has lost: `-ln I` in even light, or Paganin's thickness.

    ratio: δ/β, if it is known; then fringes become thickness (in units of their own). Without it fringes stay: where
    they are weak, `-ln I` is a round filter of the projected matter (Teague 1983), and as consistent as projections.
    """
    frames = torch.from_numpy(scan.frames)
    evened = Light.of(frames, light).evened(frames)
    if ratio is not None and bool(scan.exposures.distance.all()):
        return paganin(evened, scan.exposures, TRIAL_DELTA, TRIAL_DELTA / ratio).double() / scan.views.pixel_size
    return -evened.double().clamp_min(DARKEST).log()
