"""The illumination of frames that a reconstruction is compared with, estimated from the air of each frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from ..methods import Method, Task
from ..methods.cross_validation import predicted_frames
from ..methods.illumination import still_order
from ..optics.background import FLUX, Light, LightOptions
from ..optics.patterns import mean_light
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
