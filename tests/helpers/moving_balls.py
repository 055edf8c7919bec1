"""Frames of balls that move, in beams that are not where they are said to be at any time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch.nn.functional import pad

from helpers.discs import ball_lines
from helpers.misaligned_balls import BALLS, MATERIAL, PIXEL, SHAPE
from holosplat.beamline.misalignment import Misalignment
from holosplat.geometry import Views
from holosplat.model import Instrument
from holosplat.scan import Exposures, Scan
from holosplat.volume import LineIntegrals

WAYS = np.random.default_rng(3).uniform(-3, 3, size=(len(BALLS), 3))
"""How far each ball moves from the middle of the times to their end [pixels]."""


def beams(angles: tuple[float, ...]) -> Exposures:
    """Those that are planned."""
    return Exposures.of(Views.from_angles(list(angles), SHAPE, PIXEL), 20.0, 0.1, 0.3)


def thickness(views: Views, when: float, balls: int = len(BALLS)) -> torch.Tensor:
    """Line integrals [V, H, W] [pixels] at a time from -1 to 1."""
    lines = sum(
        ball_lines(views, (*(np.array(ball[:3]) + when * way), ball[3]), 3) for ball, way in zip(BALLS[:balls], WAYS)
    )
    assert isinstance(lines, torch.Tensor)
    return lines / views.pixel_size


def series(planned: Exposures, errors: Misalignment, times: int, drift: float = 0.0) -> tuple[Scan, Exposures]:
    """Frames said to be of the planned beams at all times, and the true exposures: every second beam's rows drift by
    `drift` pixels from the first time to the last, the others' by as much the other way."""
    true = errors.true_exposures(planned).repeated(np.arange(times) * 1e-3)
    when = np.linspace(-1, 1, times)
    shifts = true.views.shifts.copy()
    shifts[:, 1] += (
        0.25 * drift * PIXEL * np.repeat(when, len(planned)) * np.tile(np.resize([1.0, -1.0], len(planned)), times)
    )
    true = replace(true, views=replace(true.views, shifts=shifts))
    frames = []
    for n in range(len(true)):
        instrument = Instrument(true[[n]], 2)
        fine = true.views[[n]].refined(2)
        balls = [
            (*(2 * (np.array(ball[:3]) + when[n // len(planned)] * way)), 2 * ball[3]) for ball, way in zip(BALLS, WAYS)
        ]
        lines = sum(ball_lines(fine, ball, 1) for ball in balls)
        assert isinstance(lines, torch.Tensor)
        my, mx = (2 * m for m in instrument.margin)
        wide = pad(lines, (mx, mx, my, my))[:, None]
        frames.append(instrument.frames(LineIntegrals(wide, ((MATERIAL.delta, MATERIAL.beta),)))[0].numpy())
    return Scan(np.array(frames), planned.repeated(np.arange(times) * 1e-3), np.zeros(len(true), dtype=bool)), true
