"""Figures of uneven light, and of phase beside it."""

from __future__ import annotations

import numpy as np
import pytest

from holosplat.checks import InputError
from holosplat.report.content import LitViews
from holosplat.report.light import light_figure, phase_figure

PITCH = 1e-7


def image(axes) -> np.ndarray:
    return np.asarray(axes.images[0].get_array())


def test_what_light_and_prediction_leave_is_drawn():
    """Frames that are the prediction in slopes of 3 % leave nothing; light is drawn in per cent."""
    slope = 1 + 0.03 * np.linspace(-1, 1, 28) * np.ones((2, 20, 1))
    predicted = 1 + 0.1 * np.sin(np.arange(28.0)) * np.ones((2, 20, 1))
    views = LitViews(predicted * slope, slope, predicted, ("θ = 0.0°", "θ = 9.0°"), "uneven by 1.78%")
    frame, light, rest = light_figure(views, PITCH).axes[:6:2]  # by column, the first row
    np.testing.assert_allclose(image(frame), views.measured[0])
    np.testing.assert_allclose(image(light), 100 * (slope[0] - 1), atol=1e-9)
    assert np.abs(image(rest)).max() < 1e-9
    with pytest.raises(InputError, match="light"):
        LitViews(predicted, slope[:1], predicted, ("a", "b"), "")


def test_phase_is_drawn_beside_even_light():
    """Of five frames three are drawn: the first, the middle and the last."""
    phase = -np.linspace(0, 1, 28) * np.arange(1.0, 6)[:, None, None] * np.ones((20, 1))
    axes = phase_figure(1 + 0.1 * phase, None, phase, tuple("abcde"), np.full(5, PITCH)).axes
    assert all((image(one) == 0).all() for one in axes[3:6])
    for one, number in zip(axes[6:9], (0, 2, 4)):
        np.testing.assert_array_equal(image(one), phase[number])
