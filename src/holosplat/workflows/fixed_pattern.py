"""Fixed pattern: the common factor of all frames beside their matter, where a flat field is missing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..baselines import HolographicTV
from ..checks import require
from ..matter import MaterialPrior
from ..methods.illumination import predicted_first
from ..optics.patterns import mean_light
from ..progress import Progress
from ..scan import Scan

FEWEST = 2
"""Least number of training frames: in one frame, light and matter cannot be separated."""


@dataclass(frozen=True)
class FixedPatternOptions:
    """Options of the estimate of a fixed pattern."""

    order: int
    """Half waves across a frame up to which light changes, such as 4; its mean is taken to be right. 0: any pattern,
    pixel by pixel, which takes views enough for errors of the volume to differ from one to another."""
    inside: float = 0.0
    """Distance from the axis within which matter lies [m] (0: anywhere)."""
    misfit: float = 3.0
    """Weight of total variation, as `HolographicTV.misfit`; smooth light only."""
    iterations: int = 300
    """Steps of tomography."""

    def __post_init__(self) -> None:
        require(0 <= self.order <= 32, f"still light must have 0 to 32 half waves, but it has {self.order}.")
        require(self.inside >= 0, f"matter must lie within 0 m or more, but it is {self.inside:g} m.")


def estimate_fixed_pattern(
    scan: Scan, prior: MaterialPrior, options: FixedPatternOptions, on_progress: Progress
) -> np.ndarray:
    """The light [H, W], relative to the flat field, that the training frames of `scan` have in common.

    Their matter is made by phase retrieval and total variation, with an occupancy of at most one where `prior` knows
    the material; smooth light is an unknown of that. The light is then the geometric mean of measured over predicted
    frames: matter that turns is in other pixels in every frame, and averages out. What all frames show in the same
    pixels is taken for light, also of matter that is round about the axis and is not in the volume.

    Errors: `InputError` for fewer than `FEWEST` frames.
    """
    train = scan.train()
    require(len(train) >= FEWEST, f"still light needs at least {FEWEST} frames for training, but there is one.")
    how = HolographicTV(
        iterations=options.iterations if options.order else HolographicTV.iterations,
        still_light=options.order,
        misfit=options.misfit if options.order else 0.0,
        inside=options.inside,
        upper=prior.bound(1.0),
    )
    predicted = predicted_first(train, prior, how, on_progress)
    return mean_light(train.measured, predicted, options.order).float().numpy()


def flatfield_corrected(
    scan: Scan,
    prior: MaterialPrior,
    options: FixedPatternOptions,
    on_progress: Progress = lambda stage, fraction: None,
) -> Scan:
    """The scan with all frames, held-out ones too, divided by the fixed pattern of the training frames."""
    light = estimate_fixed_pattern(scan, prior, options, on_progress)
    said = {"still_light": f"{np.log(light).std():.2%} (rms), order {options.order}, divided out"}
    return scan.divided(light[None], said)
