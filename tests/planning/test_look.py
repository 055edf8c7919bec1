"""What a few frames show, beside what was put into them."""

from __future__ import annotations

import numpy as np
import pytest

from holosplat.planning.look import looked


def waves(period: float, amplitude: float, noise: float) -> np.ndarray:
    """Two frames of waves of such a period [pixels] along the columns, in white noise, about a level of 2."""
    columns = np.arange(256)
    clean = 1 + amplitude * np.sin(2 * np.pi * columns / period) * np.ones((2, 200, 1))
    return (2 * (clean + noise * np.random.default_rng(3).standard_normal(clean.shape))).astype(np.float32)


def test_the_finest_period_above_the_noise_is_that_of_the_waves():
    look = looked(waves(8.0, 0.2, 0.05) + waves(40.0, 0.2, 0.0) - 2)
    assert look.spectrum.finest == pytest.approx(8.0, rel=0.1)
    assert look.noise == pytest.approx(0.05, rel=0.15)
    assert look.contrast == pytest.approx(np.hypot(0.2, 0.05), rel=0.1)
    assert "down to periods of" in look.fringes(np.array([2.5]))


def test_noise_alone_shows_nothing():
    look = looked(waves(8.0, 0.0, 0.05))
    assert look.spectrum.finest is None
    assert "below the noise" in look.fringes(np.array([2.0, 2.5]))
    assert look.fringes(np.zeros(2)).startswith("none in contact;")
    assert look.air == pytest.approx(2.0, rel=0.01)


def test_a_frame_larger_than_what_is_looked_at_has_the_same_noise():
    large = 1 + 0.03 * np.random.default_rng(1).standard_normal((1, 1300, 1100))
    assert looked(large.astype(np.float32)).noise == pytest.approx(0.03, rel=0.1)
