"""The picture of a survey: where the best distance and energy lie, and what is seen there."""

from __future__ import annotations

from collections.abc import Callable

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter, NullLocator

from ..frames import evenly
from ..planning.plan import NEARLY, WANTED_SNR, Survey
from .style import (
    CYCLE,
    FAINT,
    HOLOGRAM_MAP,
    INK,
    RECONSTRUCTION,
    WIDTH,
    colour_bar,
    decimal_scale,
    format_length,
    image_panel,
    letter,
    new_figure,
    scale_bar,
    scientific,
    styled,
)

MAP = "viridis"
MOST_CURVES = 5


@styled
def survey_figure(survey: Survey) -> Figure:
    """Signal to noise over distance and energy, its curves at several energies, and the frame at the best point.

    Where only one of the two varies there is no map.
    """
    has_map = min(survey.information.shape) > 1
    figure = new_figure(WIDTH if has_map else 5.5, 2.42 if has_map else 2.12, "none")
    photons = f"Signal to noise, {scientific(survey.photons_per_pixel, 2)} photons a pixel"
    bottom, left, index = 0.69 if has_map else 0.39, 0.43, 0
    if has_map:
        _map_panel(figure, _place(figure, (left, bottom, 2.05, 1.55)), survey)
        letter(figure.axes[0], 0, photons)
        left, index = 3.2, 1
    curves = _place(figure, (left, bottom, 1.37 if has_map else 2.35, 1.55))
    (_distance_panel if len(survey.distances) > 1 else _energy_panel)(curves, survey)
    letter(curves, index, "At several energies" if has_map else photons)
    left = figure.get_figwidth() - 1.86
    frame = _place(figure, (left, bottom + 0.35, 1.2, 1.2))
    bar = _place(figure, (left + 1.25, bottom + 0.4, 0.08, 1.1))
    _frame_panel(figure, frame, bar, survey)
    letter(frame, index + 1, "Contrast at the best point")
    return figure


def _place(figure: Figure, box: tuple[float, float, float, float]) -> Axes:
    """Axes at `(left, bottom, width, height)` [inches]."""
    width, height = figure.get_size_inches()
    return figure.add_axes((box[0] / width, box[1] / height, box[2] / width, box[3] / height))


def _map_panel(figure: Figure, axes: Axes, survey: Survey) -> None:
    snr, distances, energies = survey.snr, survey.distances, survey.energies_kev
    low, high = max(float(snr.min()), 1e-3 * float(snr.max())), float(snr.max())
    drawn = axes.pcolormesh(
        distances,
        energies,
        snr,
        cmap=MAP,
        norm=LogNorm(low, high) if high > low else None,
        shading="gouraud",
        rasterized=True,
    )
    if float(snr.min()) < WANTED_SNR < high:
        axes.contour(distances, energies, snr, levels=[WANTED_SNR], colors="white", linewidths=1.0)
    best, near = distances[survey.best_distances()], survey.near_distances()
    axes.plot(best, energies, color=INK, lw=1.1, clip_on=False, zorder=4)
    axes.plot(near, energies, color=INK, lw=0.9, ls=(0, (2, 1.5)))
    energy, distance = survey.best
    point = {"marker": "*", "ms": 8, "mfc": RECONSTRUCTION, "mec": "white", "mew": 0.6, "ls": "none"}
    axes.plot(distances[distance], energies[energy], **point, clip_on=False, zorder=6)
    _distance_axis(axes, distances)
    axes.set(ylabel="photon energy (keV)", ylim=(energies[0], energies[-1]))
    box = axes.get_position()
    bar_axes = figure.add_axes((box.x1 + 0.01, box.y0, 0.011, box.height))
    figure.colorbar(drawn, cax=bar_axes).outline.set_linewidth(0.4)  # type: ignore[operator]
    _log_ticks(bar_axes.yaxis, fine=high / low < 10**2.5)
    bar_axes.yaxis.set_minor_locator(NullLocator())
    bar_axes.tick_params(length=2, width=0.4, pad=2)
    marks = [
        Line2D([], [], color=INK, lw=1.1, label="best distance at each energy"),
        Line2D([], [], color=INK, lw=0.9, ls=(0, (2, 1.5)), label=f"shortest with {100 * NEARLY:.0f} % of its SNR"),
        Line2D([], [], **point, label="best of all"),
    ]
    if float(snr.min()) < WANTED_SNR < high:
        outlined = [withStroke(linewidth=2.0, foreground=INK)]
        marks.append(Line2D([], [], color="white", lw=1.0, path_effects=outlined, label=f"SNR {WANTED_SNR:g}"))
    figure.legend(handles=marks, loc="lower left", bbox_to_anchor=(0.05, 0.0), ncols=len(marks), columnspacing=1.6)


def _log_ticks(axis: Axis, fine: bool, text: Callable[[float], str] = "{:g}".format) -> None:
    """Ticks of a logarithmic axis at powers of ten, and where it is `fine` at 2 and 5 times them, as `text`."""
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if fine else (1.0,)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: text(value)))
    axis.set_minor_formatter(NullFormatter())


def _distance_axis(axes: Axes, distances: np.ndarray) -> None:
    axes.set_xscale("log")
    axes.set(xlabel="distance", xlim=(distances[0], distances[-1]))
    _log_ticks(axes.xaxis, distances[-1] / distances[0] < 10**1.6, _distance)


def _distance(metres: float) -> str:
    for unit, factor in (("m", 1.0), ("cm", 1e2), ("mm", 1e3)):
        if metres * factor >= 0.9995:
            return f"{metres * factor:.3g} {unit}"
    return format_length(metres)


def _distance_panel(axes: Axes, survey: Survey) -> None:
    """Signal to noise over the distance, one curve an energy."""
    count = len(survey.energies_kev)
    shown = evenly(count, MOST_CURVES).tolist()
    # Light blue to dark blue: energies have an order.
    colours = matplotlib.colormaps["YlGnBu"](np.linspace(0.95, 0.5, len(shown)))
    for e, colour in zip(shown, colours if count > 1 else [CYCLE[0]]):
        axes.plot(survey.distances, survey.snr[e], color=colour, label=f"{survey.energies_kev[e]:.3g} keV")
        best = int(np.argmax(survey.snr[e]))
        axes.plot(survey.distances[best], survey.snr[e, best], "o", ms=3, color=colour, clip_on=False, zorder=5)
    _distance_axis(axes, survey.distances)
    _snr_axis(axes, survey)


def _energy_panel(axes: Axes, survey: Survey) -> None:
    """Signal to noise over the energy, at the one distance."""
    label = _distance(survey.setup.distance)
    axes.plot(survey.energies_kev, survey.snr[:, 0], color=CYCLE[0], label=label)
    energy, _ = survey.best
    axes.plot(survey.energies_kev[energy], survey.snr[energy, 0], "o", ms=3, color=CYCLE[0], clip_on=False, zorder=5)
    axes.set(xlabel="photon energy (keV)", xlim=(survey.energies_kev[0], survey.energies_kev[-1]))
    _snr_axis(axes, survey)


def _snr_axis(axes: Axes, survey: Survey) -> None:
    """The axis of signal to noise, and the legend beside the panel."""
    low, high = float(survey.snr.min()), float(survey.snr.max())
    axes.set_yscale("log")
    axes.set(ylabel="signal to noise", ylim=(0.8 * low, 1.6 * high))
    _log_ticks(axes.yaxis, fine=high / low < 100)
    if 0.8 * low < WANTED_SNR < 1.6 * high:
        axes.axhline(WANTED_SNR, color=FAINT, lw=0.8, ls=(0, (4, 2)))
    axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.03), borderaxespad=0.2)


def _frame_panel(figure: Figure, axes: Axes, bar: Axes, survey: Survey) -> None:
    """The contrast of the pixels at the best point, the object on the corner of four."""
    setup, pixel = survey.setup, survey.setup.pixel_size
    n = len(survey.best_frame)
    rows, columns = np.nonzero(np.abs(survey.best_frame) > 0.05 * np.abs(survey.best_frame).max())
    reach = int(np.ceil(np.abs(np.concatenate([rows, columns]) - 0.5 * (n - 1)).max()))
    cut = max(0, n // 2 - reach - 2)
    frame = survey.best_frame[cut : n - cut, cut : n - cut]
    scale, power = decimal_scale(float(np.abs(frame).max()))
    limit = float(np.abs(frame).max()) / scale
    drawn = image_panel(axes, frame / scale, (pixel, pixel), HOLOGRAM_MAP, (-limit, limit))
    scale_bar(axes, frame.shape[1] * pixel)
    colour_bar(figure, drawn, bar, f"contrast ({power})" if power else "contrast")
    said = f"{setup.energy_kev:.3g} keV, {_distance(setup.distance)},\n{format_length(pixel)} pixels"
    axes.set_xlabel(said, labelpad=4)
