"""The blocks of the page that show bodies in motion."""

from __future__ import annotations

import base64

import numpy as np

from .animation import animation
from .block import Block, drawn_block
from .moving import Moving
from .moving_figures import film_figure, grey_of, residual_of, shapes_figure, trajectories_figure

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
    figure, (low, high) = film_figure(moving), grey_of(moving)
    rms = float(np.sqrt(np.mean(np.square(np.subtract(moving.predicted, moving.measured, dtype=np.float64)))))
    text = (
        "a, bodies as the beam of the frames below sees them, in the same place and to the same scale. b, measured "
        f"frames; c, what the bodies predict of them; both on the grey scale {low:.3f} to {high:.3f}. d, their "
        f"difference, whose colours end at ±{residual_of(moving):.2g} and whose root mean square is {rms:.2g}."
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
