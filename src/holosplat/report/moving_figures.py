"""Bodies in motion: trajectories, shapes over time, a film strip and an animation, with their captions."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon, Rectangle
from PIL import Image, features
from scipy.spatial import ConvexHull

from ..frames import evenly
from ..geometry import Grid
from .content import Moving
from .style import (
    FAINT,
    HOLOGRAM_MAP,
    INK,
    SIGNED_MAP,
    WIDTH,
    Block,
    PanelGrid,
    decimal_scale,
    drawn_block,
    grey_limits,
    image_panel,
    largest,
    letter,
    new_figure,
    scale_bar,
    styled,
)
from .surface import UNIT, body_colours, box_edges, camera, paint_bodies

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
            x, y = (UNIT * moving.tracks[f"{'xyz'[axis]}_m"][:, k] for axis in (across, 1))
            axes.plot(x, y, color=colour, lw=0.7, alpha=0.6)
            whole = moving.whole[:, k]
            axes.plot(np.where(whole, x, np.nan), np.where(whole, y, np.nan), color=colour, lw=1.8)
            axes.plot(x[-1:], y[-1:], "o", ms=3, color=colour)
            for time, opacity in ((0, 0.07), (-1, 0.2)):
                vertices = UNIT * moving.bodies.bodies(float(moving.times[time]))[k].vertices[:, [across, 1]]
                outline = vertices[ConvexHull(vertices).vertices]
                axes.add_patch(Polygon(outline, fc=(*colour, opacity), ec=(*colour, 3 * opacity), lw=0.5))
            axes.annotate(
                str(k), (x[-1], y[-1]), (3, 2), textcoords="offset points", fontsize=6, color=INK, annotation_clip=True
            )
        margin = 0.15 * (high - low)
        axes.set(xlim=(low[across] - margin[across], high[across] + margin[across]))
        axes.set(ylim=(high[1] + margin[1], low[1] - margin[1]), aspect="equal", xlabel=f"{'xyz'[across]} (µm)")
        letter(axes, i, f"seen along {'zx'[i]}")
        if i == 0:
            axes.set_ylabel("y, the rotation axis (µm)")
    return figure


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
    chosen = evenly(len(moving.shown), STRIP).tolist()
    height, width = moving.measured.shape[1:]
    panels = PanelGrid(4, [width] * len(chosen), [height] * len(chosen), (len(chosen) - 1,))
    grey, limit = grey_limits(moving.measured), largest(moving.predicted - moving.measured)
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


MOST_BYTES = 400_000
"""Size of a moving picture, at most: a page holds several figures of a tenth of that."""
QUALITIES = (75, 55, 35, 20)
SMALLER = 0.7
"""What the edges of pictures are multiplied by where the lowest quality is still too large."""
SECONDS = 4.0
"""How long a round takes, and `LONGEST` how long a picture stays, at most [s]."""
LONGEST = 0.5
ANIMATION_DPI = 100


def animation(moving: Moving, most_bytes: int = MOST_BYTES) -> bytes | None:
    """A WebP picture that moves, of at most `most_bytes`; None where Pillow was built without WebP."""
    if not features.check("webp"):
        return None
    seconds = min(LONGEST, SECONDS / len(moving.shown))
    return encode_animation([_picture(moving, k) for k in range(len(moving.shown))], seconds, most_bytes)


def encode_animation(pictures: Sequence[np.ndarray], seconds: float, most_bytes: int) -> bytes:
    """RGB pictures [H, W, 3] uint8 as one WebP that moves: each stays for `seconds`, over and over.

    Its quality, and then its size, are lowered until it has no more than `most_bytes`.
    """
    images = [Image.fromarray(picture) for picture in pictures]
    while True:
        for quality in QUALITIES:
            buffer = io.BytesIO()
            how = {"duration": round(1000 * seconds), "loop": 0, "quality": quality, "method": 4}
            images[0].save(buffer, "WEBP", save_all=True, append_images=images[1:], **how)
            if buffer.tell() <= most_bytes or min(images[0].size) < 16:
                return buffer.getvalue()
        size = tuple(max(1, round(SMALLER * edge)) for edge in images[0].size)
        images = [image.resize((size[0], size[1]), Image.Resampling.LANCZOS) for image in images]


@styled
def _picture(moving: Moving, k: int) -> np.ndarray:
    """One picture [H, W, 3] uint8: the bodies from the side above, and three small panels of frames."""
    high, wide = moving.measured.shape[1:]
    figure = new_figure(7.2, 3.6, "none")
    figure.set_dpi(ANIMATION_DPI)
    _turned(figure.add_axes((0.0, 0.0, 0.43, 0.93)), moving, k)
    time = 1e6 * float(moving.times[moving.shown[k]])
    figure.text(0.02, 0.93, f"{time:.1f} µs", fontsize=10, weight="bold")
    limit, pixel = largest(moving.predicted - moving.measured), float(moving.views[[k]].pixel_sizes[0])
    panels = (
        ("measured", moving.measured[k], HOLOGRAM_MAP, grey_limits(moving.measured)),
        ("predicted", moving.predicted[k], HOLOGRAM_MAP, grey_limits(moving.measured)),
        ("difference", moving.predicted[k] - moving.measured[k], SIGNED_MAP, (-limit, limit)),
    )
    upright = high > wide  # panels side by side, or one over the other
    for i, (name, image, colours, limits) in enumerate(panels):
        place = (0.435 + 0.188 * i, 0.02, 0.183, 0.92) if upright else (0.44, 0.665 - 0.325 * i, 0.55, 0.265)
        axes = figure.add_axes(place)
        image_panel(axes, image, (pixel, pixel), colours, limits)
        axes.set_title(name, fontsize=7.5, pad=3)
    canvas = figure.canvas
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()  # type: ignore[attr-defined]


def _turned(axes: Axes, moving: Moving, k: int) -> None:
    """The bodies in their field, whose box stays in place."""
    views, time = moving.views, float(moving.times[moving.shown[k]])
    grid, rotation = Grid.of_views(views), camera()
    at = UNIT * (rotation @ grid.centre)[:2]
    edges = [UNIT * points + at for points in box_edges(grid, rotation)]
    for points in edges:
        axes.plot(points[:, 0], points[:, 1], lw=0.5, color=INK, alpha=0.4, zorder=0)
    paint_bodies(axes, moving.bodies.bodies(time), rotation, np.zeros(2), body_colours(moving.bodies.count))
    every = np.concatenate(edges)
    low, high = every.min(0), every.max(0)
    half = 0.58 * (high - low)
    axes.set(xlim=(at[0] - half[0], at[0] + half[0]), ylim=(at[1] + half[1], at[1] - half[1]), aspect="equal")
    axes.set_axis_off()
    left, right = axes.get_xlim()
    scale_bar(axes, 1e-6 * (right - left), INK, 0.03)


COLOURS = "A body has the same colour and number in all figures. "


def motion_blocks(moving: Moving) -> list[Block]:
    """Moving picture, film strip, ways, and shapes over time."""
    return [_animation(moving), _film(moving), _trajectories(moving), _shapes(moving)]


def _animation(moving: Moving) -> Block:
    heading, picture = "Motion", animation(moving)
    if picture is None:
        return Block(heading, "Pillow was built without WebP here, so no moving picture was made.")
    image = f"data:image/webp;base64,{base64.b64encode(picture).decode()}"
    text = (
        f"The bodies in the field of view from the side above, at {len(moving.shown)} of {len(moving.times)} times "
        f"from {1e6 * moving.times[0]:.4g} to {1e6 * moving.times[-1]:.4g} µs, beside one frame of each of these, what "
        f"the bodies predict of it, and the difference. {COLOURS}"
    )
    return Block(heading, text.strip(), "Bodies in motion.", image, 100)


def _film(moving: Moving) -> Block:
    figure, (low, high) = film_figure(moving), grey_limits(moving.measured)
    limit = largest(moving.predicted - moving.measured)
    rms = float(np.sqrt(np.mean(np.square(np.subtract(moving.predicted, moving.measured, dtype=np.float64)))))
    text = (
        "a, bodies as the beam of the frames below sees them, in the same place and to the same scale. b, measured "
        f"frames; c, what the bodies predict of them; both on the grey scale {low:.3f} to {high:.3f}. d, their "
        f"difference, whose colours end at ±{limit:.2g} and whose root mean square is {rms:.2g}."
    )
    return drawn_block("Film strip", text, "Bodies and frames over time.", figure)


def _trajectories(moving: Moving) -> Block:
    text = (
        "Ways of the bodies' centres, thick where the whole body is in the field of view (dashed), and outlines at the "
        f"first (light) and the last time, where dots and numbers are. {COLOURS}"
    )
    return drawn_block("Ways", text, "Ways of the bodies.", trajectories_figure(moving))


def _shapes(moving: Moving) -> Block:
    known = [name for name in ("volume_m3", "area_m2", "deformation") if name in moving.errors]
    text = (
        "Volume, area and deformation (a − c)/(a + c) of each body over time; a and c are the longest and shortest "
        "half axes of the ellipsoid of the same second moments. Thick: the whole body is in the field of view; scales "
        "are made for these. "
    )
    text += "Bands are standard errors, from fits to halves of the frames." if known else "Errors were not estimated."
    return drawn_block("Shapes", text, "Shapes over time.", shapes_figure(moving))
