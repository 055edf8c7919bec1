"""Frames as images that are linear in what the beam passed: what moments and sinograms are taken of."""

from __future__ import annotations

from dataclasses import replace

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
    """Images [V, H, W], float64, of what each frame has lost: `-ln I` in even light, or Paganin's thickness; NaN in
    missing pixels.

    ratio: δ/β, if it is known; then fringes become thickness (in units of their own). Without it fringes stay: where
    they are weak, `-ln I` is a round filter of the projected matter (Teague 1983), and as consistent as projections.
    """
    evened = torch.from_numpy(in_even_light(scan, light).frames)
    if ratio is None or not bool(scan.exposures.distance.all()):
        return -scan.known(evened).double().clamp_min(DARKEST).log()
    lost = paganin(evened, scan.exposures, TRIAL_DELTA, TRIAL_DELTA / ratio, missing=scan.gaps)
    return scan.known(lost).double() / scan.views.pixel_size


def in_even_light(scan: Scan, light: LightOptions = EVEN_OR_NOT) -> Scan:
    """The scan as it would be in even light."""
    frames = Light.of(scan.measured, light).evened(torch.from_numpy(scan.frames))
    return replace(scan, frames=frames.numpy())
