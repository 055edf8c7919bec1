"""Frames of balls whose views are not where they are said to be."""

from __future__ import annotations

import numpy as np
import torch
from torch.nn.functional import pad

from helpers.discs import ball_lines
from holosplat.beamline.misalignment import Misalignment
from holosplat.geometry import Views
from holosplat.matter import DeltaBeta
from holosplat.model import Instrument
from holosplat.scan import Exposures, Scan
from holosplat.volume import LineIntegrals

MATERIAL = DeltaBeta(5e-7, 5e-10)
PIXEL, SHAPE = 3.2e-6, (35, 41)
BALLS = ((6.4, -5.6, 2.4, 4.8), (-8.0, 2.4, 6.4, 4.0), (1.6, 7.2, -8.8, 4.0), (-5.6, -8.8, -6.4, 3.2)) + (
    (10.4, 4.8, 4.8, 3.2),
    (-1.6, 0.8, -1.6, 2.8),
    (3.2, -10.4, 9.6, 2.4),
    (-11.2, 9.6, -2.4, 2.4),
)
"""x, y, z and radius [pixels]."""


def scan_of(errors: Misalignment, count: int = 12, test_every: int = 4) -> tuple[Scan, Exposures]:
    """Frames of balls, from chords, said to be of the planned exposures; and the true exposures."""
    planned = Exposures.of(Views.evenly_spaced(count, SHAPE, PIXEL), 20.0, 0.1, 0.3)
    true = errors.true_exposures(planned)
    instrument = Instrument(true, 2)
    lines = sum(ball_lines(true.views.refined(2), tuple(2 * v for v in ball), 2) for ball in BALLS)
    my, mx = (2 * m for m in instrument.margin)
    assert isinstance(lines, torch.Tensor)
    wide = pad(lines, (mx, mx, my, my))[:, None]
    frames = instrument.frames(LineIntegrals(wide, ((MATERIAL.delta, MATERIAL.beta),)))
    held_out = np.arange(count) % test_every == test_every - 1
    return Scan(frames.numpy(), planned, held_out), true
