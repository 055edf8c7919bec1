"""Frames, the uneven light that is found in them, and what is left or retrieved."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage

from ..optics.sampling import fringes
from ..planning.look import Spectrum
from ..planning.scan_facts import OPTICS, ScanFacts
from .content import LitViews, pixel_of
from .figures import evenly_chosen
from .style import (
    FAINT,
    HOLOGRAM_MAP,
    INK,
    RECONSTRUCTION,
    SIGNED_MAP,
    WIDTH,
    PanelGrid,
    colour_bar,
    decimal_scale,
    from_dark,
    image_panel,
    letter,
    new_figure,
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


FRAMES_SHOWN = (0, 1)
"""Of the frames that were looked at, those that are drawn: the first, and the one in the middle."""
MOST_ZEROS = 6
"""Zeros of the contrast transfer that are marked."""


@styled
def look_figure(found: ScanFacts) -> Figure:
    """The first frame and the one in the middle, and the power spectrum of all that were looked at."""
    look, pixel = found.look, float(found.scan.views.pixel_sizes[0])
    shown = [n for n in FRAMES_SHOWN if n < len(look.frames)]
    h, w = look.frames.shape[1:]
    size = 1.75
    high = min(max(size * h / w, 0.5), 2.6)
    figure = new_figure(WIDTH, max(high, 1.6) + 0.75)
    grid = figure.add_gridspec(1, len(shown) + 2, width_ratios=[*([1.0] * len(shown)), 0.06, 1.15])
    limits = _limits(look.frames[shown])
    drawn = None
    for k, n in enumerate(shown):
        axes = figure.add_subplot(grid[0, k])
        drawn = image_panel(axes, look.frames[n], (pixel, pixel), HOLOGRAM_MAP, limits)
        if "pixel_size" not in found.unsaid:
            scale_bar(axes, w * pixel)
        letter(axes, k, f"Frame {found.numbers[n]}")
    if drawn is not None:
        name = "Relative intensity" if look.is_relative else "Counts"
        colour_bar(figure, drawn, figure.add_subplot(grid[0, len(shown)]), name, "both")
    axes = figure.add_subplot(grid[0, len(shown) + 1])
    _spectrum(axes, look.spectrum, found, pixel)
    letter(axes, len(shown), "Power spectrum")
    return figure


def _limits(frames: np.ndarray) -> tuple[float, float]:
    low, high = (float(each) for each in np.quantile(frames[:, ::2, ::2], (0.002, 0.998)))
    return (low, high) if high > low else (low - 0.5, low + 0.5)


def _spectrum(axes: Axes, spectrum: Spectrum, found: ScanFacts, pixel: float) -> None:
    """Power over frequency, the noise, and the zeros of a weak phase object's contrast, f = √(n/λz)."""
    axes.semilogy(spectrum.frequency, spectrum.power, color=RECONSTRUCTION, label="frames")
    if spectrum.noise > 0:
        axes.axhline(spectrum.noise, color=INK, lw=0.7, ls="--", label="their noise")
    if set(found.unsaid).isdisjoint(OPTICS):
        width = float(fringes(found.scan.exposures)[0]) / pixel
        places = [math.sqrt(n) / width for n in range(1, MOST_ZEROS + 1)] if width > 0 else []
        for n, place in enumerate(place for place in places if place < spectrum.frequency[-1]):
            axes.axvline(place, color=FAINT, lw=0.6, label="zeros of phase contrast, √(n/λz)" if n == 0 else None)
    axes.set_xlabel("Spatial frequency (cycles per pixel)")
    axes.set_ylabel("Power of contrast")
    axes.set_xlim(0, 0.5)
    if spectrum.power.max(initial=0.0) > 0:
        axes.set_ylim(bottom=max(spectrum.power.max() * 1e-9, 0.3 * spectrum.power.min()))
    axes.legend(loc="best")
