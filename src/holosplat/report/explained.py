"""The figure of a verdict: what a reconstruction leaves of the training frames, by spatial frequency and view."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..units import plain
from ..workflows.verdict import Verdict
from .style import CYCLE, FAINT, INK, RECONSTRUCTION, WIDTH, colour_bar, letter, new_figure, styled

LARGEST = 3.0
"""Residual over what is allowed at which colours end."""


@styled
def explained_figure(found: Verdict) -> Figure:
    """Residual, noise and contrast by band (left), and the residual over what is allowed by view and band (right)."""
    figure = new_figure(WIDTH, 2.4)
    left, right, bar = figure.subplots(1, 3, width_ratios=[1.1, 1.0, 0.045])
    _curves(left, found)
    letter(left, 0, "By period")
    over = found.residual / np.maximum(found.allowed, 1e-30)
    drawn = right.imshow(
        over, cmap="magma", vmin=0, vmax=LARGEST, aspect="auto", interpolation="nearest", origin="lower"
    )
    right.set_xticks(range(over.shape[1]), _labels(found))
    right.tick_params(axis="x", labelrotation=40)
    right.set(xlabel="shortest period (µm)", ylabel="training view")
    right.set_yticks(*_views(len(over)))
    letter(right, 1, "By view")
    colour_bar(figure, drawn, bar, "residual / allowed", "max")
    return figure


def _curves(axes: Axes, found: Verdict) -> None:
    places = np.arange(found.residual.shape[1])
    rms = {
        name: np.sqrt(np.mean(np.square(getattr(found, name)), axis=0))
        for name in ("contrast", "noise", "allowed", "residual")
    }
    how = {
        "contrast": {"color": FAINT, "ls": (0, (1, 1.5))},
        "noise": {"color": CYCLE[1]},
        "allowed": {"color": INK, "ls": (0, (4, 2)), "lw": 0.8},
        "residual": {"color": RECONSTRUCTION, "marker": "o", "ms": 3.0},
    }
    top = max(float(rms["contrast"].max()), float(rms["residual"].max()), 1e-12)
    for name, values in rms.items():
        axes.plot(places, np.where(values > 1e-5 * top, values, np.nan), label=name, **how[name])
    axes.set_yscale("log")
    axes.set_xticks(places, _labels(found))
    axes.tick_params(axis="x", labelrotation=40)
    axes.set(xlabel="shortest period (µm)", ylabel="rms of coefficients")
    axes.legend(loc="best")


def _labels(found: Verdict) -> list[str]:
    return [plain(1e6 * shortest) for shortest in found.periods[:, 0]]


def _views(count: int) -> tuple[list[int], list[str]]:
    """Ticks of views, counted from 1."""
    step = max(1, -(-count // 12))
    places = list(range(0, count, step))
    return places, [str(place + 1) for place in places]
