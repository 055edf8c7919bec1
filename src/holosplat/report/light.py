"""Frames, the uneven light that is found in them, and what is left or retrieved."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure
from matplotlib.image import AxesImage

from .content import LitViews, pixel_of
from .figures import evenly_chosen
from .style import (
    HOLOGRAM_MAP,
    SIGNED_MAP,
    PanelGrid,
    decimal_scale,
    from_dark,
    image_panel,
    letter,
    scale_bar,
    styled,
)

PHASE_MAP = "magma"
SHOWN = (0.2, 99.8)
"""Percentiles at which colours end: single hot pixels do not fade the rest."""


@styled
def light_figure(views: LitViews, pixel_size: float) -> Figure:
    """Measured frame, the light in it, and what light and reconstruction leave of it; pixel_size [m]."""
    residual = views.measured - views.predicted * views.light
    limit = _largest(residual)
    scale, power = decimal_scale(limit)
    panels = _panels(views.measured, bars=(0, 1, 2))
    for row in range(len(views.labels)):
        pixel = pixel_of(views, row, pixel_size)
        grey = _frame(panels, row, views.measured, views.labels[row], pixel)
        lit = _light(panels, row, views.light, pixel)
        axes = panels.axes[row][2]
        left = image_panel(axes, residual[row] / scale, (pixel, pixel), SIGNED_MAP, (-limit / scale, limit / scale))
        letter(axes, 3 * row + 2, "Left by light and object")
    rows = (0, len(views.labels) - 1)
    panels.bar(grey, 0, rows, "relative intensity", "both")
    panels.bar(lit, 1, rows, "light − 1 (%)", "both")
    panels.bar(left, 2, rows, f"difference{f' ({power})' if power else ''}", "both")
    return panels.figure


@styled
def phase_figure(
    measured: np.ndarray,
    light: np.ndarray | None,
    phase: np.ndarray,
    labels: Sequence[str],
    pixel_sizes: np.ndarray,
    most: int = 3,
) -> Figure:
    """Up to `most` frames [V, H, W], the light in them (None: even), and the phase [rad] of the exit wave.

    pixel_sizes: [V] [m].
    """
    chosen = evenly_chosen(len(measured), most)
    measured, phase = measured[chosen], phase[chosen]
    factor = np.ones_like(phase) if light is None else light[chosen]
    panels = _panels(measured, bars=(0, 1, 2))
    low, high = (float(v) for v in np.percentile(phase, (0.02, 99.98)))
    limits = (low, high) if high > low else (low - 0.5, low + 0.5)
    for row, number in enumerate(chosen):
        pixel_size = float(pixel_sizes[number])
        grey = _frame(panels, row, measured, labels[number], pixel_size)
        lit = _light(panels, row, factor, pixel_size)
        axes = panels.axes[row][2]
        shown = image_panel(axes, phase[row], (pixel_size, pixel_size), from_dark(PHASE_MAP, limits), limits)
        letter(axes, 3 * row + 2, "Phase")
    rows = (0, len(chosen) - 1)
    panels.bar(grey, 0, rows, "relative intensity", "both")
    panels.bar(lit, 1, rows, "light − 1 (%)", "both")
    panels.bar(shown, 2, rows, "phase (rad)", "both")
    return panels.figure


def _panels(images: np.ndarray, bars: tuple[int, ...]) -> PanelGrid:
    count, height, width = images.shape
    return PanelGrid(count, [width] * 3, [height] * 3, bars)


def _frame(panels: PanelGrid, row: int, frames: np.ndarray, label: str, pixel_size: float) -> AxesImage:
    low, high = (float(v) for v in np.percentile(frames, SHOWN))
    limits = (low, high) if high > low else (low - 0.5, low + 0.5)
    axes = panels.axes[row][0]
    drawn = image_panel(axes, frames[row], (pixel_size, pixel_size), HOLOGRAM_MAP, limits)
    letter(axes, 3 * row, f"Measured, {label}")
    scale_bar(axes, frames.shape[2] * pixel_size)
    return drawn


def _light(panels: PanelGrid, row: int, light: np.ndarray, pixel_size: float) -> AxesImage:
    axes, limit = panels.axes[row][1], 100 * float(np.abs(light - 1).max()) or 1.0
    drawn = image_panel(axes, 100 * (light[row] - 1), (pixel_size, pixel_size), SIGNED_MAP, (-limit, limit))
    letter(axes, 3 * row + 1, "Light in it")
    return drawn


def _largest(images: np.ndarray) -> float:
    return float(np.percentile(np.abs(images), SHOWN[1])) or 1.0
