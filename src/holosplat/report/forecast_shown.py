"""The part of a report on a forecast: its uncertainty, and its scores on held-out frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

from .style import INK, WIDTH, Block, drawn_block, letter, new_figure, styled
from .surface import body_colours

BUSY = 16
"""Bodies beyond which the legend takes another column."""


@dataclass(frozen=True)
class ForecastShown:
    """A forecast, as data.

    - times: [N] s; band: [N, B] m, standard error of each body's surface along its normals, NaN where nothing tells it
    - flow: what mechanics found of the flow, and what they cannot tell, in words
    - held_out: scores of frames that the run did not see, a row a time: time_s, ssim, and ssim_still, of bodies that
      stay where they were
    """

    times: np.ndarray
    band: np.ndarray
    held_out: Sequence[Mapping[str, float]] = ()
    flow: str = ""


def forecast_block(shown: ForecastShown) -> Block:
    """The figure with its caption; a sentence where nothing tells the error and no frames judge."""
    heading, told = "Forecast", bool(np.isfinite(shown.band).any())
    if not told and not shown.held_out:
        return Block(heading, "Errors were not estimated, and the scan has no frames of the forecast's times.")
    text = "Over the time of the scan. "
    text += (
        "a, standard error of each body's surface along its normals, root mean square over it, from fits to halves of "
        "the frames and from a forecast of the last known time. "
        if told
        else "a, errors were not estimated. "
    )
    text += (
        f"b, structural similarity of predicted frames with {len(shown.held_out)} that the run did not see, and of "
        "frames of bodies that stay where they were. "
        if shown.held_out
        else "b, the scan has no frames of these times."
    )
    text += f" Mechanics found of the {shown.flow}." if shown.flow else ""
    return drawn_block(heading, text.strip(), "The forecast's error and scores.", forecast_figure(shown))


@styled
def forecast_figure(shown: ForecastShown) -> Figure:
    """Errors of the bodies, and scores of the frames, over time."""
    figure = new_figure(WIDTH, 2.4)
    errors, scores = figure.subplots(1, 2)
    count = shown.band.shape[1]
    for k, colour in enumerate(body_colours(count)):
        errors.plot(1e6 * shown.times, 1e6 * shown.band[:, k], ".-", ms=3, color=colour, lw=1.0, label=str(k))
    errors.set(xlabel="time (µs)", ylabel="standard error (µm)")
    if np.isfinite(shown.band).any():
        errors.set_ylim(bottom=0)
    when = [1e6 * row["time_s"] for row in shown.held_out]
    for name, label, style in (("ssim", "forecast", "-"), ("ssim_still", "without change", ":")):
        scores.plot(when, [row[name] for row in shown.held_out], f".{style}", ms=4, color=INK, label=label)
    scores.set(xlabel="time (µs)", ylabel="SSIM of held-out frames", xlim=errors.get_xlim())
    if when:
        scores.legend(loc="lower left")
    for i, axes in enumerate((errors, scores)):
        letter(axes, i)
    handles, labels = errors.get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside right center", title="body", ncols=-(-count // BUSY), handlelength=1.0,
        title_fontsize=6.5,
    )  # fmt: skip
    return figure
