"""Frames, the uneven light that is found in them, and what is left or retrieved."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..frames import evenly
from ..optics.sampling import fringes
from ..planning.look import Spectrum
from ..planning.scan_facts import OPTICS, ScanFacts
from ..preprocess import fault_of
from .content import LitViews, pixel_of
from .style import (
    FAINT,
    HOLOGRAM_MAP,
    INK,
    RECONSTRUCTION,
    SIGNED_MAP,
    WIDTH,
    PanelGrid,
    around_zero,
    colour_bar,
    decimal_scale,
    grey_limits,
    image_panel,
    largest,
    letter,
    new_figure,
    scale_bar,
    styled,
)

PHASE_MAP = "magma"


@styled
def light_figure(views: LitViews, pixel_size: float) -> Figure:
    """Measured frame, the light in it, and what light and reconstruction leave of it; pixel_size [m]."""
    residual = views.measured - views.predicted * views.light
    limit = largest(residual)
    scale, power = decimal_scale(limit)
    how = (SIGNED_MAP, (-limit / scale, limit / scale))
    names = ("Left by light and object", f"difference{f' ({power})' if power else ''}")
    pixels = [pixel_of(views, row, pixel_size) for row in range(len(views.labels))]
    return _beside(views.measured, views.light, (residual / scale, *how, *names), views.labels, pixels)


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
    chosen = evenly(len(measured), most)
    phase, limits = phase[chosen], grey_limits(phase[chosen], (0.02, 99.98))
    factor = np.ones_like(phase) if light is None else light[chosen]
    third = (phase, *around_zero(PHASE_MAP, limits), "Phase", "phase (rad)")
    return _beside(measured[chosen], factor, third, [labels[int(n)] for n in chosen], pixel_sizes[chosen].tolist())


def _beside(
    measured: np.ndarray,
    light: np.ndarray,
    third: tuple[np.ndarray, str, tuple[float, float], str, str],
    labels: Sequence[str],
    pixels: Sequence[float],
) -> Figure:
    """Frames [V, H, W] of `pixels` [m], their light, and a third image: its colours and limits, its name, and that of
    its bar."""
    count, height, width = measured.shape
    panels = PanelGrid(count, [width] * 3, [height] * 3, (0, 1, 2))
    limit = 100 * float(np.abs(light - 1).max()) or 1.0
    columns = (
        (measured, HOLOGRAM_MAP, grey_limits(measured), "Measured", "relative intensity"),
        (100 * (light - 1), SIGNED_MAP, (-limit, limit), "Light in it", "light − 1 (%)"),
        third,
    )
    for column, (images, colours, limits, name, said) in enumerate(columns):
        for row, pixel in enumerate(pixels):
            axes = panels.axes[row][column]
            drawn = image_panel(axes, images[row], (pixel, pixel), colours, limits)
            letter(axes, 3 * row + column, name if column else f"{name}, {labels[row]}")
            if column == 0:
                scale_bar(axes, width * pixel)
        panels.bar(drawn, column, (0, count - 1), said, "both")
    return panels.figure


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
    limits = grey_limits(look.frames[shown][:, ::2, ::2])
    drawn = None
    for k, n in enumerate(shown):
        axes = figure.add_subplot(grid[0, k])
        drawn = image_panel(axes, look.frames[n], (pixel, pixel), HOLOGRAM_MAP, limits)
        if "pixel_size" not in found.unsaid:
            scale_bar(axes, w * pixel)
        letter(axes, k, f"Frame {found.numbers[n]}")
    if drawn is not None:
        name = "Counts" if fault_of(look.level) else "Relative intensity"
        colour_bar(figure, drawn, figure.add_subplot(grid[0, len(shown)]), name, "both")
    axes = figure.add_subplot(grid[0, len(shown) + 1])
    _spectrum(axes, look.spectrum, found, pixel)
    letter(axes, len(shown), "Power spectrum")
    return figure


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
    axes.legend(loc="best", frameon=True, framealpha=1.0, edgecolor="none")  # the noise would cross its words
