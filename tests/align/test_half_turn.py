"""Where a half turn ends: at 180° or a step before it, by the frames, whatever the scan says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from helpers.discs import PITCH, ball_lines
from holosplat.align import find_axis
from holosplat.align.consistency import may_be_half
from holosplat.geometry import Views
from holosplat.scan import Exposures, Scan

BALLS = ((9.0, -6.0, 4.0, 8.0), (-11.0, 2.0, 7.0, 6.0), (3.0, 9.0, -12.0, 5.0), (-6.0, -12.0, -9.0, 4.0))
"""x, y, z and radius [pixels]."""
SHAPE, COUNT, OFFSET = (21, 63), 60, 2.3
SHORT, WHOLE = np.arange(COUNT) * 180.0 / COUNT, np.linspace(0, 180, COUNT)


@pytest.fixture(autouse=True)
def _unjudged(monkeypatch) -> None:
    """What frames say of the axis is not held against unseen views, as tests/align/test_axis.py does."""
    monkeypatch.setattr("holosplat.align.axis._judged", lambda axis, *given: axis)


def scan_of(true, said, noise=0.002, drift=0.0) -> Scan:
    """Balls in contact at angles `true` [degrees], of which the scan says `said`; drift: of light, first to last."""
    views = Views.from_angles(true, SHAPE, PITCH)
    views = replace(views, shifts=views.shifts - [OFFSET * PITCH, 0.0])
    lines = np.sum([ball_lines(views, ball, 3).numpy() for ball in BALLS], axis=0) / PITCH
    frames = np.exp(-0.02 * lines) + noise * np.random.default_rng(1).standard_normal(lines.shape)
    frames *= 1 + drift * np.linspace(0, 1, len(true))[:, None, None] * np.linspace(-1, 1, SHAPE[1])
    planned = Exposures.of(Views.from_angles(said, SHAPE, PITCH), 20.0, 0.0)
    return Scan(frames.astype(np.float32), planned, np.zeros(len(true), dtype=bool))


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize(("true", "said", "drift"), [(WHOLE, SHORT, 0.0), (WHOLE, SHORT, 0.02), (SHORT, WHOLE, 0.0)])
def test_the_last_frame_is_put_where_its_mirror_image_says(true, said, drift, sign):
    scan = scan_of(sign * true, sign * said, drift=drift)
    found = find_axis(scan)
    assert found.turn is not None
    assert np.rad2deg(found.turn.found) == pytest.approx(true[-1])
    assert found.lines()[0].startswith(f"angles: the last frame is at {true[-1]:.3f}° from the first")
    assert found.offset.value == pytest.approx(OFFSET, abs=0.1)
    wanted = Views.from_angles(sign * true, SHAPE, PITCH).rotations
    np.testing.assert_allclose(replace(found, lean=None).applied(scan.exposures).views.rotations, wanted, atol=1e-9)


@pytest.mark.parametrize(("noise", "drift"), [(0.002, 0.0), (0.05, 0.0), (0.2, 0.0), (0.002, 0.02)])
@pytest.mark.parametrize("angles", [WHOLE, SHORT])
def test_right_angles_stay(angles, noise, drift):
    """Where noise drowns what a step changes, and where light drifts, too."""
    assert find_axis(scan_of(angles, angles, noise, drift)).turn is None


def test_only_half_turns_of_even_steps_are_judged():
    assert may_be_half(np.deg2rad(WHOLE))
    assert may_be_half(-np.deg2rad(SHORT))
    assert not may_be_half(np.deg2rad(SHORT[::6]))
    assert not may_be_half(np.deg2rad(np.linspace(0, 170, COUNT)))
    assert not may_be_half(np.deg2rad(2 * SHORT))
    assert not may_be_half(np.deg2rad(SHORT + np.random.default_rng(0).normal(0, 0.3, COUNT)))
