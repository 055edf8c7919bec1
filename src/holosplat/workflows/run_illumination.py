"""The illumination of frames that a reconstruction is compared with, by the air of each frame; and the fixed pattern:
the common factor of all frames beside their matter, where a flat field is missing."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from ..baselines import HolographicTV
from ..checks import require
from ..matter import MaterialPrior
from ..methods import Method, Task
from ..methods.cross_validation import predicted_frames
from ..methods.illumination import predicted_first, still_order
from ..optics.background import FLUX, Light, LightOptions
from ..optics.patterns import mean_light
from ..progress import Progress
from ..representations import Stored
from ..scan import Scan
from ..tables import from_table

EVEN = LightOptions("even")
"""Frames are compared as they are."""


def light_options_of(task: Task) -> LightOptions:
    """What a run assumes of other frames of its scan: smooth light if that of the training frames is uneven; other
    frames are taken to have the mean flux."""
    known = task.uneven and task.uneven.background
    return EVEN if known is None or known.is_flux else replace(task.light, kind="smooth")


def read_light_options(config: Mapping[str, Any], summary: Mapping[str, Any]) -> LightOptions:
    """The same of a run folder; older ones say nothing of light, which is then even."""
    said = str(summary.get("light", "even"))
    if said == "even" or said.startswith(("the same", FLUX)):
        return EVEN
    return replace(from_table(LightOptions, config.get("light", {}), "light"), kind="smooth")


def fixed_pattern_of(task: Task, method: Method, found: Stored, oversample: int) -> np.ndarray | None:
    """The light [H, W] that the frames of a run have in common, float32; None where they have none.

    It was divided out before (`prepared`), or is an unknown of `method`: then it is the residual of the frames.
    """
    if task.lit is not None and task.lit.still is not None:
        return task.lit.still.numpy().astype(np.float32)
    order = still_order(method)
    if not order:
        return None
    predicted = predicted_frames(task.scan.exposures, found, oversample)
    return mean_light(task.scan.measured, predicted, order).numpy().astype(np.float32)


def light_of(scan: Scan, assumed: LightOptions, still: np.ndarray | None = None) -> Light | None:
    """The light of all frames of `scan`, held-out ones too, by their air; None where it is even.

    The power of light at each number of half waves is estimated from all frames together; the light itself is each
    frame's own. A frame without air has its prior mean, even light; so have all frames where none has air.
    still: [H, W], beside that: what the training frames of the run have in common, and frames of this raster with them.
    """
    frames = scan.measured
    common = None if still is None or still.shape != scan.views.shape else torch.from_numpy(still).double()
    if common is not None:
        frames = (frames / common).float()
    smooth = assumed.kind != "even" and bool(assumed.air_of(frames).any())
    if not smooth and common is None:
        return None
    if smooth and scan.light is not None:
        return replace(Light.handed(frames, assumed, scan.light), still=common)
    found = Light.of(frames, assumed if smooth else EVEN)
    return None if found.background is None and common is None else replace(found, still=common)


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
