"""Figures of bodies in motion: their ways, their shapes over time, and a film strip beside the frames."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon, Rectangle
from scipy.spatial import ConvexHull

from .body_picture import UNIT, body_colours, paint_bodies
from .figures import evenly_chosen
from .moving import Moving
from .style import (
    FAINT,
    HOLOGRAM_MAP,
    INK,
    SIGNED_MAP,
    WIDTH,
    PanelGrid,
    decimal_scale,
    image_panel,
    letter,
    new_figure,
    scale_bar,
    styled,
)

STRIP = 6
"""Times of a film strip, at most."""
SHAPES = (
    ("volume_m3", 1e18, "volume (µm³)"),
    ("area_m2", 1e12, "area (µm²)"),
    ("deformation", 1.0, "deformation (a − c)/(a + c)"),
)
"""What is drawn over time: column, factor, and label."""
Limits = tuple[float, float]


@styled
def trajectories_figure(moving: Moving) -> Figure:
    """Ways of the centres in two projections, x–y and z–y, with outlines at the first and last time and the field."""
    low, high = UNIT * moving.low, UNIT * moving.high
    size = 1.3 * (high - low)
    panel = 0.42 * WIDTH
    height = min(panel * size[1] / max(size[0], size[2]), 1.3 * panel)
    figure = new_figure(WIDTH, height + 0.5)
    colours = body_colours(moving.bodies.count)
    for i, (axes, across) in enumerate(zip(figure.subplots(1, 2, sharey=True), (0, 2))):
        corner, extent = (low[across], low[1]), (high[across] - low[across], high[1] - low[1])
        axes.add_patch(Rectangle(corner, *extent, fill=False, ec=INK, lw=0.8, ls=(0, (4, 2))))
        for k, colour in enumerate(colours):
            _way(axes, moving, k, across, colour)
        margin = 0.15 * (high - low)
        axes.set(xlim=(low[across] - margin[across], high[across] + margin[across]))
        axes.set(ylim=(high[1] + margin[1], low[1] - margin[1]), aspect="equal", xlabel=f"{'xyz'[across]} (µm)")
        letter(axes, i, f"seen along {'zx'[i]}")
        if i == 0:
            axes.set_ylabel("y, the rotation axis (µm)")
    return figure


def _way(axes: Axes, moving: Moving, body: int, across: int, colour: tuple[float, float, float]) -> None:
    """The way of one body, thin where it is not whole in the field; a dot and its number at the last time."""
    x, y = (UNIT * moving.tracks[f"{'xyz'[axis]}_m"][:, body] for axis in (across, 1))
    axes.plot(x, y, color=colour, lw=0.7, alpha=0.6)
    whole = moving.whole[:, body]
    axes.plot(np.where(whole, x, np.nan), np.where(whole, y, np.nan), color=colour, lw=1.8)
    axes.plot(x[-1:], y[-1:], "o", ms=3, color=colour)
    for time, opacity in ((0, 0.07), (-1, 0.2)):
        vertices = UNIT * moving.bodies.bodies(float(moving.times[time]))[body].vertices[:, [across, 1]]
        outline = vertices[ConvexHull(vertices).vertices]
        axes.add_patch(Polygon(outline, fc=(*colour, opacity), ec=(*colour, 3 * opacity), lw=0.5))
    axes.annotate(
        str(body), (x[-1], y[-1]), (3, 2), textcoords="offset points", fontsize=6, color=INK, annotation_clip=True
    )


@styled
def shapes_figure(moving: Moving) -> Figure:
    """Volume, area and deformation of each body over time, with one standard error where that is known."""
    figure = new_figure(WIDTH, 2.6)
    every, colours = figure.subplots(1, len(SHAPES)), body_colours(moving.bodies.count)
    for i, (axes, (name, factor, label)) in enumerate(zip(every, SHAPES)):
        values, errors = factor * moving.tracks[name], moving.errors.get(name)
        for k, colour in enumerate(colours):
            whole, t = moving.whole[:, k], 1e6 * moving.times
            axes.plot(t, values[:, k], color=colour, lw=0.5, alpha=0.35)
            axes.plot(t, np.where(whole, values[:, k], np.nan), color=colour, lw=1.2, label=str(k) if i == 0 else None)
            if errors is not None:
                band = np.where(whole, factor * errors[:, k], np.nan)
                axes.fill_between(t, values[:, k] - band, values[:, k] + band, color=colour, alpha=0.25, lw=0)
        axes.set(xlabel="time (µs)", ylabel=label, xlim=(t[0], t[-1]), ylim=_limits(values, moving.whole))
        letter(axes, i)
    columns = -(-moving.bodies.count // 16)
    figure.legend(loc="outside right center", title="body", ncols=columns, handlelength=1.0, title_fontsize=6.5)
    return figure


def _limits(values: np.ndarray, whole: np.ndarray) -> Limits:
    """Limits of an axis for the values of whole bodies, or for all where there are none."""
    known = values[whole] if whole.any() else values.ravel()
    low, high = float(known.min()), float(known.max())
    margin = 0.12 * (high - low) or 0.05 * abs(high) or 1.0
    return low - margin, high + margin


@styled
def film_figure(moving: Moving) -> Figure:
    """Bodies, measured and predicted frames, and their difference, at a few times, all seen along one beam."""
    chosen = evenly_chosen(len(moving.shown), STRIP)
    height, width = moving.measured.shape[1:]
    panels = PanelGrid(4, [width] * len(chosen), [height] * len(chosen), (len(chosen) - 1,))
    grey, limit = grey_of(moving), residual_of(moving)
    scale, power = decimal_scale(limit)
    images = []
    for column, k in enumerate(chosen):
        view, time = moving.views[[k]], float(moving.times[moving.shown[k]])
        pixel = float(view.pixel_sizes[0])
        bodies, *others = (panels.axes[row][column] for row in range(4))
        bodies_panel(bodies, moving, k)
        pitch, residual = (pixel, pixel), (moving.predicted[k] - moving.measured[k]) / scale
        images = [
            image_panel(others[0], moving.measured[k], pitch, HOLOGRAM_MAP, grey),
            image_panel(others[1], moving.predicted[k], pitch, HOLOGRAM_MAP, grey),
            image_panel(others[2], residual, pitch, SIGNED_MAP, (-limit / scale, limit / scale)),
        ]
        if column == 0:
            for row, name in enumerate(("Bodies", "Measured", "Predicted", "Predicted − measured")):
                letter(panels.axes[row][0], row, name)
            scale_bar(bodies, width * pixel, INK)
        bodies.annotate(
            f"{1e6 * time:.4g} µs", (1, 1), (0, 3), xycoords="axes fraction", textcoords="offset points", ha="right"
        )
    panels.bar(images[0], len(chosen) - 1, (1, 2), "relative intensity", "both")
    panels.bar(images[2], len(chosen) - 1, (3, 3), f"difference{f' ({power})' if power else ''}", "both")
    return panels.figure


def bodies_panel(axes: Axes, moving: Moving, shown: int) -> None:
    """The bodies at the time `shown`, as its frame sees them: to the same scale, in the same place."""
    view, time = moving.views[[shown]], float(moving.times[moving.shown[shown]])
    half = 0.5 * UNIT * float(view.pixel_sizes[0]) * np.array(moving.measured.shape[1:])
    colours = body_colours(moving.bodies.count)
    paint_bodies(axes, moving.bodies.bodies(time), view.rotations[0], view.shifts[0], colours)
    axes.set(xlim=(-half[1], half[1]), ylim=(half[0], -half[0]), xticks=[], yticks=[], aspect="equal")
    for spine in axes.spines.values():
        spine.set(visible=True, linewidth=0.4, color=FAINT)


def grey_of(moving: Moving) -> Limits:
    """The grey scale of frames: the 0.2 and 99.8 percentiles of the measured ones."""
    low, high = (float(value) for value in np.percentile(moving.measured, [0.2, 99.8]))
    return (low, high) if high > low else (low - 0.5, low + 0.5)


def residual_of(moving: Moving) -> float:
    """Limit of the colours of differences: the 99.8 percentile of their magnitude."""
    return float(np.percentile(np.abs(moving.predicted - moving.measured), 99.8)) or 1.0
