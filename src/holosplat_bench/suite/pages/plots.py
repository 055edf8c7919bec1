"""The plots of a benchmark: quality against cost, correlation curves, and all cases at a glance."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.colors import to_rgb, to_rgba
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from holosplat.report.style import CYCLE, FAINT, INK, WIDTH, letter, new_figure, styled

from ..run import TRUTH_THRESHOLD
from .results import BYTES, HEADLINE, OURS, SECONDS, CaseResult, Measure, MethodResult

MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")
DASHES = ("solid", (0, (5, 1.5)), (0, (1.5, 1)), (0, (5, 1.5, 1.5, 1.5)), (0, (8, 2)), (0, (3, 1, 1, 1, 1, 1)))
SHADES = (0.0, -0.45, 0.4, -0.2, 0.2, -0.65)
"""How far a family's methods go from its colour towards black (below zero) or white."""


@dataclass(frozen=True)
class Mark:
    """Colour, marker and dashes of one method."""

    name: str
    colour: tuple[float, float, float]
    marker: str
    dashes: str | tuple

    def handle(self, line: bool = False) -> Line2D:
        """What stands for the method in a legend: its marker, or its line."""
        if line:
            return Line2D([], [], color=self.colour, ls=self.dashes, label=self.name)
        return Line2D([], [], ls="none", label=self.name, **self.style())

    def style(self) -> dict:
        """Options of `plot` for a marker."""
        size = 6.2 if self.marker == "*" else 4.6
        return {"marker": self.marker, "ms": size, "mfc": to_rgba(self.colour, 0.3), "mec": self.colour, "mew": 0.9}


def marks_of(cases: Sequence[CaseResult]) -> dict[str, Mark]:
    """A mark for every method of all cases, the same in all plots."""
    families: dict[str, list[str]] = {}
    for method in (method for case in cases for method in case.methods):
        names = families.setdefault(method.family, [])
        if method.name not in names:
            names.append(method.name)
    return {
        name: Mark(name, _shade(CYCLE[f % len(CYCLE)], SHADES[i % 6]), MARKERS[(i + f) % 8], DASHES[i % 6])
        for f, names in enumerate(families.values())
        for i, name in enumerate(names)
    }


def _shade(colour: str, towards: float) -> tuple[float, float, float]:
    """`colour`, mixed with white by a part `towards`, or with black where that is negative."""
    end = 1.0 if towards > 0 else 0.0
    red, green, blue = (channel + abs(towards) * (end - channel) for channel in to_rgb(colour))
    return red, green, blue


LEGEND_COLUMNS = 5
CEILING, LINES = "truth-on-voxels", "tv-true-lines"
"""References that plots show as lines."""
LOWEST = -0.1
"""Correlations are drawn down to here."""
SMALLEST = 1e-4
"""Deficits below are drawn here: a logarithm has no place for none."""

Marks = Mapping[str, Mark]
Curves = Mapping[str, Mapping[str, np.ndarray]]


def deficit(measure: Measure, value: float) -> float:
    """What is missing to a perfect score: 1 - SSIM, 1 - FRCM, 1 - Dice, or the error itself."""
    return max(SMALLEST, 1.0 - value if measure.better == "high" else value)


def deficit_name(measure: Measure) -> str:
    """How an axis calls it."""
    return f"1 − {measure.name}" if measure.better == "high" else measure.name


@styled
def tradeoff_figure(case: CaseResult, marks: Marks) -> Figure:
    """Deficits of the methods against time (above) and stored size (below), all axes logarithmic; means over seeds."""
    shown = [method for method in case.methods if method.done]
    handles = [marks[method.name].handle() for method in shown]
    references = [r for r in case.references if r.done]
    handles += [Line2D([], [], color=FAINT, ls=_dashes(r), lw=0.9, label=r.name) for r in references]
    axes, figure = _panels(2, len(HEADLINE), 1.55, handles)
    costs = ((SECONDS, "time (s)"), (BYTES, "stored size (bytes)"))
    for row, (cost, label) in enumerate(costs):
        for column, measure in enumerate(HEADLINE):
            panel = axes[row][column]
            _tradeoff_panel(panel, shown, marks, measure, cost)
            for reference in references:
                _reference_line(panel, reference, measure)
            log_ticks(panel.xaxis)
            log_ticks(panel.yaxis)
            panel.set(xlabel=label, ylabel=deficit_name(measure))
            letter(panel, row * len(HEADLINE) + column, measure.name)
    return figure


def _tradeoff_panel(axes: Axes, shown: Sequence[MethodResult], marks: Marks, measure: Measure, cost: Measure) -> None:
    axes.set(xscale="log", yscale="log")
    points = []
    for method in shown:
        x, y = method.mean(cost), method.mean(measure)
        if x and y is not None and math.isfinite(y):
            points.append((x, deficit(measure, y)))
            style = marks[method.name].style()
            axes.plot(*points[-1], ls="none", zorder=3, clip_on=False, scalex=False, scaley=False, **style)
    if not points:
        return
    draw_front(axes, points, (1.5, 1.25), lw=0.7)


def draw_front(axes: Axes, points: Sequence[tuple[float, float]], margins: tuple[float, float], lw: float) -> None:
    """Steps along the front of `points`, on axes that reach beyond all of them by these factors."""
    (wide, high), (xs, ys) = margins, zip(*points)
    axes.set(xlim=(min(xs) / wide, max(xs) * wide), ylim=(min(ys) / high, max(ys) * high))
    x, y = zip(*pareto_front(points))
    axes.step([*x, wide * max(xs)], [*y, y[-1]], where="post", color=FAINT, lw=lw, zorder=1)


def pareto_front(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """The points that none other beats in both coordinates (small is good), from left to right."""
    front: list[tuple[float, float]] = []
    for x, y in sorted(points):
        if not front or y < front[-1][1]:
            front.append((x, y))
    return front


def _reference_line(axes: Axes, reference: MethodResult, measure: Measure) -> None:
    """A dashed line at a reference, unless it is perfect by its making; the axis grows to hold it."""
    value = reference.mean(measure)
    if value is None or deficit(measure, value) <= SMALLEST:
        return
    level = deficit(measure, value)
    axes.axhline(level, color=FAINT, lw=0.9, ls=_dashes(reference), zorder=0)
    low, high = axes.get_ylim()
    axes.set_ylim(min(low, level / 1.25), max(high, level * 1.25))


def _dashes(reference: MethodResult) -> str | tuple:
    return (0, (4, 2)) if reference.name == CEILING else (0, (1, 1.5))


def log_ticks(axis: Axis) -> None:
    """Plain numbers: at 1, 2 and 5 times powers of ten where a logarithmic axis spans little, else at fewer."""
    low, high = axis.get_view_interval()
    decades = math.log10(high / low)
    subs = (1.0, 2.0, 5.0) if decades < 1.5 else (1.0, 3.0) if decades < 2.6 else (1.0,)
    axis.set_major_locator(LogLocator(subs=subs))
    axis.set_major_formatter(FuncFormatter(lambda value, _: _plain(value)))
    axis.set_minor_locator(NullLocator())


def _plain(value: float) -> str:
    for unit, factor in (("M", 1e6), ("k", 1e3)):
        if value >= 0.9995 * factor:
            return f"{value / factor:g}{unit}"
    return f"{value:g}"


def _panels(rows: int, columns: int, height: float, handles: Sequence[Line2D]) -> tuple[list[list[Axes]], Figure]:
    """Axes in a grid, each row `height` [inches] high, and the legend of all of them below."""
    lines = math.ceil(len(handles) / LEGEND_COLUMNS)
    foot = 0.14 * lines + 0.1
    figure = new_figure(WIDTH, rows * height + foot)
    share = foot / (rows * height + foot)
    figure.get_layout_engine().set(rect=(0, share, 1, 1 - share), h_pad=0.06)  # type: ignore[union-attr]
    axes = figure.subplots(rows, columns, squeeze=False)
    figure.legend(
        handles=list(handles),
        loc="lower center",
        ncols=min(LEGEND_COLUMNS, max(1, len(handles))),
        columnspacing=1.2,
        handletextpad=0.4,
        borderaxespad=0.1,
    )
    return [list(row) for row in axes], figure


@styled
def curves_figure(pictures: Curves, marks: Marks, pixel_size: float) -> Figure | None:
    """Fourier ring correlation of held-out holograms and shell correlation of δ, a line a method; pixel_size [m].

    pictures: method → its arrays (`bench.pictures`). None without any.
    """
    shown = {name: arrays for name, arrays in pictures.items() if name in marks}
    if not shown:
        return None
    axes, figure = _panels(1, 2, 2.5, [marks[name].handle(line=True) for name in shown])
    left, right = axes[0]
    for name, arrays in shown.items():
        style = {"color": marks[name].colour, "ls": marks[name].dashes, "lw": 1.6 if name == OURS else 0.9}
        left.plot(1e-6 * arrays["frequency"] / pixel_size, arrays["frc"], **style)
        right.plot(1e-6 * arrays["shells"] / float(arrays["pitch"]), arrays["fsc"], **style)
    right.axhline(TRUTH_THRESHOLD, color=INK, lw=0.7, ls=(0, (4, 2)))
    for i, (panel, title) in enumerate(((left, "Held-out holograms"), (right, "Volume of δ against the truth"))):
        panel.set(xlabel="spatial frequency (µm⁻¹)", xlim=(0, None), ylim=(LOWEST, 1.03))
        letter(panel, i, title)
    left.set_ylabel("Fourier ring correlation")
    right.set_ylabel("Fourier shell correlation")
    return figure


@styled
def sizes_figure(pictures: Curves, marks: Marks, pixel_size: float) -> Figure | None:
    """Contrast of balls over their diameter [pixels], a line a method; None for a case without; pixel_size [m]."""
    shown = {name: arrays for name, arrays in pictures.items() if name in marks and "diameters" in arrays}
    if not shown:
        return None
    axes, figure = _panels(1, 1, 2.5, [marks[name].handle(line=True) for name in shown])
    panel, diameters = axes[0][0], np.concatenate([arrays["diameters"] for arrays in shown.values()]) / pixel_size
    for name, arrays in shown.items():
        style = {"color": marks[name].colour, "ls": marks[name].dashes, "lw": 1.6 if name == OURS else 0.9}
        panel.plot(arrays["diameters"] / pixel_size, arrays["contrast"], marker="o", ms=2.2, **style)
    panel.axhline(1.0, color=FAINT, lw=0.7, ls=(0, (4, 2)))
    panel.set_xscale("log")
    panel.set(xlim=(diameters.min() / 1.1, diameters.max() * 1.1), ylim=(LOWEST, None))
    panel.set(xlabel="diameter (pixels)", ylabel="contrast left")
    log_ticks(panel.xaxis)
    return figure


@styled
def overview_figure(cases: Sequence[CaseResult], marks: Marks) -> Figure:
    """Every method on every case: deficits on logarithmic axes, a row a case, ours larger than the others."""
    names = [name for name in marks if any(m.name == name and m.done for case in cases for m in case.methods)]
    axes, figure = _panels(1, len(HEADLINE), 0.6 + 0.17 * max(4, len(cases)), [marks[name].handle() for name in names])
    for column, (panel, measure) in enumerate(zip(axes[0], HEADLINE)):
        panel.set_xscale("log")
        drawn = []
        for row, case in enumerate(cases):
            panel.axhline(row, color=FAINT, lw=0.3, zorder=0)
            for method in case.methods:
                value = method.mean(measure)
                if value is not None and math.isfinite(value):
                    drawn.append(deficit(measure, value))
                    style, front = marks[method.name].style(), method.name == OURS
                    style["ms"] *= 1.5 if front else 1.0
                    panel.plot(drawn[-1], row, ls="none", zorder=3 + front, clip_on=False, scalex=False, **style)
        panel.set_xlim(min(drawn, default=0.1) / 1.25, max(drawn, default=1.0) * 1.25)
        panel.set_yticks(range(len(cases)), [case.name for case in cases] if column == 0 else [""] * len(cases))
        panel.set(ylim=(len(cases) - 0.5, -0.5), xlabel=deficit_name(measure))
        panel.tick_params(axis="y", length=0)
        log_ticks(panel.xaxis)
        letter(panel, column, measure.name)
    return figure
