"""Which scans can be reconstructed at all."""

from __future__ import annotations

import numpy as np

from ..checks import require
from ..scan import Scan

FEWEST_COLUMNS = 11
"""Pixels across the axis that are a field of view; rows may be as few as one."""
FLAT_LEVELS = (0.2, 5.0)
"""Between these lies the median of frames that are relative to the flat field."""
MOST_NEGATIVE = 0.25
"""Share of the pixels that may be below zero: noise makes half of those so that an absorber darkens wholly."""


def require_one_time(scan: Scan) -> None:
    """`InputError` for a time-resolved scan: one still volume cannot be all of its times."""
    times = scan.instants
    require(
        not scan.is_series,
        f"the scan must show one time, but its frames are of {len(times)}, from {times[0]:g} to {times[-1]:g} s, and "
        f"the reconstruction stands still; choose a time with --time-frame 0 … {len(times) - 1} (Scan.at_instant), or "
        "--motion flow, which finds out whether anything moves (Scan.as_static: nothing does).",
    )


def check_frames(train: Scan) -> None:
    """`InputError` for too few columns, and for frames that are not relative to the flat field."""
    h, w = train.views.shape
    require(
        w >= FEWEST_COLUMNS,
        f"frames must have at least {FEWEST_COLUMNS} columns, but they are {h} × {w} pixels; take a wider part.",
    )
    level = float(np.median(train.frames))
    require(
        FLAT_LEVELS[0] < level < FLAT_LEVELS[1],
        f"frames must be relative to the flat field (about 1 beside the sample), but their median is {level:.4g}; "
        "divide counts by their flats, with --flats and --darks or image_key 1 and 2 in the file.",
    )
    negative = float((train.frames < 0).mean())
    require(
        negative <= MOST_NEGATIVE,
        f"frames must be intensities, but {negative:.0%} of their pixels are below zero; take off less of the dark.",
    )
