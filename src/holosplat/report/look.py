"""The picture of `holosplat info`: frames of a scan with grey and scale bars, and their spectrum with fringes."""

from __future__ import annotations

import math

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..optics.sampling import fringes
from ..planning.look import Spectrum
from ..planning.scan_facts import OPTICS, ScanFacts
from .style import (
    FAINT,
    HOLOGRAM_MAP,
    INK,
    RECONSTRUCTION,
    WIDTH,
    colour_bar,
    image_panel,
    letter,
    new_figure,
    scale_bar,
    styled,
)

SHOWN = (0, 1)
"""Of the frames that were looked at, those that are drawn: the first, and the one in the middle."""
MOST_ZEROS = 6
"""Zeros of the contrast transfer that are marked."""


@styled
def look_figure(found: ScanFacts) -> Figure:
    """The first frame and the one in the middle, and the power spectrum of all that were looked at."""
    look, pixel = found.look, float(found.scan.views.pixel_sizes[0])
    shown = [n for n in SHOWN if n < len(look.frames)]
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
