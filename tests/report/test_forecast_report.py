"""The figure of a forecast: errors of bodies, and scores of held-out frames."""

from __future__ import annotations

import numpy as np

from holosplat.report.surface import ForecastShown, forecast_block, forecast_figure

TIMES = 1e-5 * np.arange(1, 5)
BAND = 1e-7 * np.outer(np.arange(1, 5), [1.0, 2.0, np.nan])
SCORES = [{"time_s": float(t), "ssim": 0.99 - 100 * t, "ssim_still": 0.9} for t in TIMES[:2]]


def test_errors_and_scores_are_drawn_in_micrometres_and_microseconds():
    errors, scores = forecast_figure(ForecastShown(TIMES, BAND, SCORES)).axes
    first, second, untold = (np.asarray(line.get_xydata(), dtype=float) for line in errors.lines)
    np.testing.assert_allclose(first, np.stack([1e6 * TIMES, 0.1 * np.arange(1, 5)], axis=1))
    np.testing.assert_allclose(second[:, 1], 2 * first[:, 1])
    assert np.isnan(untold[:, 1]).all()
    for line, name in zip(scores.lines, ("ssim", "ssim_still")):
        np.testing.assert_allclose(np.asarray(line.get_ydata(), dtype=float), [row[name] for row in SCORES])


def test_matter_in_motion_has_no_bodies():
    """Neither a legend of them nor a caption."""
    shown = ForecastShown(TIMES, BAND[:, :1], SCORES, of_bodies=False)
    assert not forecast_figure(shown).legends
    assert forecast_figure(ForecastShown(TIMES, BAND, SCORES)).legends
    assert "body" not in forecast_block(shown).caption
    assert "bodies" not in forecast_block(shown).caption
    assert "the places of matter along an axis" in forecast_block(shown).caption


def test_what_is_missing_is_said():
    text = forecast_block(ForecastShown(TIMES, np.nan * BAND)).caption
    assert "Errors were not estimated" in text
    block = forecast_block(ForecastShown(TIMES, BAND))
    assert block.drawn
    assert "no frames of these times" in block.caption
    assert "errors were not estimated" in forecast_block(ForecastShown(TIMES, np.nan * BAND, SCORES)).caption
