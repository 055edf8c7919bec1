"""Whether frames are intensities relative to the flat field, as phase retrieval and reconstruction take them."""

from __future__ import annotations

import numpy as np

from ..checks import require

RELATIVE = (0.2, 5.0)
"""Between these lies the level of frames that are relative to the flat field."""
MOST_NEGATIVE = 0.25
"""Share of the pixels that may be below zero: noise makes half of those so that an absorber darkens wholly."""


def fault_of(level: float) -> str:
    """Why frames of this `level` are not relative to the flat field; empty where they may be."""
    if RELATIVE[0] < level < RELATIVE[1]:
        return ""
    remedy = "divide counts by their flats, with --flats and --darks or image_key 1 and 2 in the file"
    if level < 1:
        remedy = "take flats of the same exposure, and none for frames that were divided before"
    wanted = "frames must be relative to the flat field (about 1 beside the sample)"
    return f"{wanted}, but their level is {level:.4g}; {remedy}."


def require_relative(frames: np.ndarray) -> None:
    """`InputError` for frames [N, H, W] that are not relative to the flat field, by their median, or no intensities."""
    fault = fault_of(float(np.median(frames)))
    require(not fault, fault)
    negative = float((frames < 0).mean())
    require(
        negative <= MOST_NEGATIVE,
        f"frames must be intensities, but {negative:.0%} of their pixels are below zero; take off less of the dark.",
    )
