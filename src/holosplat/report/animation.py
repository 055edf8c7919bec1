"""Bodies in motion as a moving picture: turned bodies, and a frame of each time beside what is predicted of it."""

from __future__ import annotations

import io
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image, features

from ..geometry import Grid
from .body_picture import UNIT, body_colours, paint_bodies
from .moving import Moving
from .moving_figures import grey_of, residual_of
from .style import HOLOGRAM_MAP, INK, SIGNED_MAP, image_panel, new_figure, scale_bar, styled
from .surface import box_edges, camera

MOST_BYTES = 400_000
"""Size of a moving picture, at most: a page holds several figures of a tenth of that."""
QUALITIES = (75, 55, 35, 20)
SMALLER = 0.7
"""What the edges of pictures are multiplied by where the lowest quality is still too large."""
SECONDS = 4.0
"""How long a round takes, and `LONGEST` how long a picture stays, at most [s]."""
LONGEST = 0.5
DPI = 100


def animation(moving: Moving, most_bytes: int = MOST_BYTES) -> bytes | None:
    """A WebP picture that moves, of at most `most_bytes`; None where Pillow was built without WebP."""
    if not features.check("webp"):
        return None
    seconds = min(LONGEST, SECONDS / len(moving.shown))
    return encoded([_picture(moving, k) for k in range(len(moving.shown))], seconds, most_bytes)


def encoded(pictures: Sequence[np.ndarray], seconds: float, most_bytes: int) -> bytes:
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
    figure.set_dpi(DPI)
    _turned(figure.add_axes((0.0, 0.0, 0.43, 0.93)), moving, k)
    time = 1e6 * float(moving.times[moving.shown[k]])
    figure.text(0.02, 0.93, f"{time:.1f} µs", fontsize=10, weight="bold")
    limit, pixel = residual_of(moving), float(moving.views[[k]].pixel_sizes[0])
    panels = (
        ("measured", moving.measured[k], HOLOGRAM_MAP, grey_of(moving)),
        ("predicted", moving.predicted[k], HOLOGRAM_MAP, grey_of(moving)),
        ("difference", moving.predicted[k] - moving.measured[k], SIGNED_MAP, (-limit, limit)),
    )
    upright = high > wide  # panels side by side, or one over the other
    for i, (name, image, colours, limits) in enumerate(panels):
        place = (0.435 + 0.188 * i, 0.02, 0.183, 0.92) if upright else (0.44, 0.665 - 0.325 * i, 0.55, 0.265)
        _frame(figure.add_axes(place), image, pixel, colours, limits, name)
    return _pixels(figure)


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


def _frame(axes: Axes, image: np.ndarray, pixel: float, colours: str, limits: tuple[float, float], title: str) -> None:
    image_panel(axes, image, (pixel, pixel), colours, limits)
    axes.set_title(title, fontsize=7.5, pad=3)


def _pixels(figure: Figure) -> np.ndarray:
    """What is drawn, [H, W, 3] uint8."""
    canvas = figure.canvas
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()  # type: ignore[attr-defined]
