"""How figures look: one palette, one set of colour maps, and the few marks that every panel shares.

Figures are built without pyplot's global state; `@styled` applies the settings while a figure is built or
saved.
"""

from __future__ import annotations

import base64
import functools
import io
import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import ParamSpec, TypeVar
from urllib.parse import quote

import matplotlib
import numpy as np
from cycler import cycler
from markupsafe import Markup
from matplotlib import font_manager, patheffects
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.ticker import MaxNLocator

from ..units import bar_length, format_length, plain

WIDTH = 7.2  # inches: the full width of a journal page, 183 mm
DPI = 160
INK, FAINT, GROUND = "#1b1f24", "#8b929b", "#fffffe"
RECONSTRUCTION, TRUTH, TRUE_SURFACE = "#c2502f", "#5a626d", "#939ca8"
CYCLE = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#5a626d")
"""Okabe & Ito's palette: distinct also for readers who do not see red and green as most do."""
IN_THE_DARK = {GROUND: "#14171b", INK: "#e6e8eb", TRUTH: "#a0a8b2"}
"""What stands for the colours of paper and ink, and of the truth's curves, where a page is dark (see `themed`)."""
DELTA_MAP, BETA_MAP, HOLOGRAM_MAP, SIGNED_MAP = "magma", "cividis", "gray", "RdBu_r"

PLAIN = " =:/,;+()!*?@"
"""What stands for itself in a `data:` URI within quotes, beside letters, digits, _, ., - and ~."""
POWER = re.compile(r"(-?\d(?:\.\d+)?)e([+-]\d+)")
"""A number with an exponent."""

ENDS = (0.2, 99.8)
"""Percentiles at which colours end: single hot pixels do not fade the rest."""

P = ParamSpec("P")
T = TypeVar("T")


@functools.cache
def settings() -> dict[str, object]:
    """Matplotlib settings: 7 pt sans serif, hairlines, text as outlines in SVG (which needs no font)."""
    installed = {font.name for font in font_manager.fontManager.ttflist}
    family = [n for n in ("Helvetica", "Arial", "Liberation Sans", "Nimbus Sans") if n in installed][:1]
    return {
        "font.family": [*family, "DejaVu Sans"],
        "font.size": 7.0,
        "axes.titlesize": 7.0,
        "axes.labelsize": 7.0,
        "axes.linewidth": 0.6,
        "axes.edgecolor": INK,
        "axes.labelcolor": INK,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.axisbelow": True,
        "axes.prop_cycle": cycler(color=CYCLE),
        "xtick.labelsize": 6.5,
        "ytick.labelsize": 6.5,
        "xtick.major.width": 0.6,
        "ytick.major.width": 0.6,
        "xtick.minor.width": 0.4,
        "ytick.minor.width": 0.4,
        "xtick.major.size": 2.5,
        "ytick.major.size": 2.5,
        "xtick.minor.size": 1.5,
        "ytick.minor.size": 1.5,
        "xtick.color": INK,
        "ytick.color": INK,
        "text.color": INK,
        "lines.linewidth": 1.1,
        "legend.frameon": False,
        "legend.fontsize": 6.5,
        "legend.handlelength": 1.6,
        "figure.dpi": DPI,
        "savefig.dpi": DPI,
        "figure.facecolor": GROUND,
        "axes.facecolor": GROUND,
        "svg.fonttype": "path",
        "svg.hashsalt": "holosplat",
    }


@functools.cache
def palette(colours: str = DELTA_MAP) -> np.ndarray:
    """Red, green and blue [256, 3] of a map of colours, from its low end on, as whole numbers up to 255."""
    return np.rint(255 * matplotlib.colormaps[colours](np.arange(256))[:, :3]).astype(int)


def styled(function: Callable[P, T]) -> Callable[P, T]:
    """Run `function` under `settings()`, and leave matplotlib's own settings as they were."""

    @functools.wraps(function)
    def run(*args: P.args, **kwargs: P.kwargs) -> T:
        with matplotlib.rc_context(settings()):  # type: ignore[arg-type]
            return function(*args, **kwargs)

    return run


def new_figure(width: float, height: float, layout: str = "constrained") -> Figure:
    """An empty figure of `width` × `height` [inches] on an Agg canvas, outside pyplot."""
    figure = Figure(figsize=(width, height), layout=layout)  # type: ignore[arg-type]
    FigureCanvasAgg(figure)
    return figure


@styled
def data_uri(figure: Figure, kind: str = "svg") -> str:
    """`figure` as a `data:` URI; kind: "svg" (images in it have `DPI`) or "png". Equal figures give equal text."""
    buffer = io.BytesIO()
    if kind == "svg":
        figure.savefig(buffer, format="svg", metadata=dict.fromkeys(("Creator", "Date", "Format", "Type")))
        # as text, for images in it are base64 already, and twice would be a third larger
        return f"data:image/svg+xml,{quote(themed(buffer.getvalue().decode()), safe=PLAIN)}"
    figure.savefig(buffer, format="png", dpi=DPI, metadata={"Software": None})
    return f"data:image/png;base64,{base64.b64encode(buffer.getvalue()).decode()}"


def themed(svg: str) -> str:
    """`svg` with the colours of `IN_THE_DARK` where its reader prefers dark pages; images in it stay as they are."""
    names = {colour: f"--c{i}" for i, colour in enumerate(IN_THE_DARK)}
    light = "".join(f"{name}: {colour};" for colour, name in names.items())
    dark = "".join(f"{name}: {IN_THE_DARK[colour]};" for colour, name in names.items())
    for colour, name in names.items():
        svg = svg.replace(f": {colour}", f": var({name})")
    rule = f"<style>:root {{{light}}} @media (prefers-color-scheme: dark) {{:root {{{dark}}}}}</style>"
    return svg.replace("<defs>", f"{rule}<defs>", 1)


def letter(axes: Axes, index: int, title: str = "", lift: float = 3.0) -> None:
    """Panel letter (a, b, c …, bold) and `title` above the left corner of `axes`, `lift` [pt] above it."""
    style = {
        "xycoords": "axes fraction",
        "textcoords": "offset points",
        "va": "bottom",
        "annotation_clip": False,
    }
    axes.annotate(chr(ord("a") + index), (0, 1), (0, lift), fontsize=8, fontweight="bold", **style)
    if title:
        axes.annotate(title, (0, 1), (10, lift), fontsize=7, **style)


def scale_bar(axes: Axes, width: float, colour: str = "white", height: float = 0.055, beside: bool = False) -> None:
    """A scale bar of a round length, up to a quarter of `width` [m] of the field, in the lower left corner.

    height: of the bar above the lower edge, as a part of the axes; the length stands above the bar, or `beside` it,
    where panels are small.
    """
    length = bar_length(width)
    fraction = length / width
    halo = {"white": "black", INK: GROUND}.get(colour, "white")
    x0, y0 = 0.05, height
    line = axes.plot([x0, x0 + fraction], [y0, y0], transform=axes.transAxes, color=colour, lw=1.8)[0]
    line.set_solid_capstyle("butt")
    line.set_path_effects([patheffects.withStroke(linewidth=2.8, foreground=halo, alpha=0.55)])
    text = axes.text(
        x0 + fraction + 0.03 if beside else x0 + fraction / 2,
        y0 if beside else y0 + 0.02,
        format_length(length),
        transform=axes.transAxes,
        color=colour,
        ha="left" if beside else "center",
        va="center" if beside else "bottom",
        fontsize=6.5,
    )
    text.set_path_effects([patheffects.withStroke(linewidth=2.0, foreground=halo, alpha=0.55)])


def image_panel(
    axes: Axes, image: np.ndarray, pitch: tuple[float, float], colours: str, limits: tuple[float, float]
) -> AxesImage:
    """`image` [H, W] drawn to scale, without ticks; pitch: pixel (column, row) [m]; limits: colour range."""
    height, width = image.shape[0] * pitch[1], image.shape[1] * pitch[0]
    drawn = axes.imshow(
        image,
        cmap=colours,
        vmin=limits[0],
        vmax=limits[1],
        extent=(0, width, height, 0),
        interpolation="nearest",
    )
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_visible(True)
        spine.set_linewidth(0.4)
    return drawn


class PanelGrid:
    """Images in rows and columns at exact places, with slots for colour bars; nothing moves to make room.

    widths, heights: sizes of the columns' images in any common unit (an image is as high as its column says);
    bars: columns that have a slot for a colour bar to their right; width: of the figure [inches].
    """

    LEFT, GAP, SLOT, TITLE, BOTTOM = 0.04, 0.12, 0.64, 0.21, 0.04  # inches

    def __init__(
        self,
        rows: int,
        widths: list[float],
        heights: list[float],
        bars: tuple[int, ...],
        width: float = WIDTH,
    ) -> None:
        slots = [self.SLOT if i in bars else self.GAP for i in range(len(widths))]
        slots[-1] = slots[-1] if len(widths) - 1 in bars else self.LEFT
        scale = (width - self.LEFT - sum(slots)) / sum(widths)
        sizes = [(w * scale, h * scale) for w, h in zip(widths, heights)]
        self._pitch = max(h for _, h in sizes) + self.TITLE
        self._height = rows * self._pitch + self.BOTTOM
        self.figure = new_figure(width, self._height, "none")
        self._right: list[float] = []
        self.axes: list[list[Axes]] = [[] for _ in range(rows)]
        left = self.LEFT
        for (panel_width, panel_height), slot in zip(sizes, slots):
            for row in range(rows):
                top = self._height - row * self._pitch - self.TITLE
                self.axes[row].append(self._at(left, top - panel_height, panel_width, panel_height))
            self._right.append(left + panel_width)
            left += panel_width + slot

    def _at(self, left: float, bottom: float, width: float, height: float) -> Axes:
        figure_width = float(self.figure.get_figwidth())
        box = (left / figure_width, bottom / self._height, width / figure_width, height / self._height)
        return self.figure.add_axes(box)

    def bar(self, drawn: AxesImage, column: int, rows: tuple[int, int], label: str, extend: str = "neither") -> None:
        """A colour bar with `label` in the slot right of `column`, along rows `first … last`."""
        last = min(rows[1], rows[0] + 1)  # two rows are long enough
        top = self._height - rows[0] * self._pitch - self.TITLE
        bottom = self._height - (last + 1) * self._pitch
        inset = 0.04 * (top - bottom)
        axes = self._at(self._right[column] + 0.06, bottom + inset, 0.085, top - bottom - 2 * inset)
        colour_bar(self.figure, drawn, axes, label, extend)


def colour_bar(figure: Figure, drawn: ScalarMappable, axes: Axes, label: str, extend: str = "neither") -> None:
    """A colour bar with `label` that fills `axes`."""
    height = axes.get_position().height * figure.get_figheight()  # [inches]
    bar = figure.colorbar(drawn, cax=axes, extend=extend, extendfrac=0.09 / height)
    bar.locator = MaxNLocator(int(np.clip(3.5 * height, 2, 6)), steps=[1, 2, 2.5, 5, 10])
    bar.update_ticks()
    bar.set_label(label if height > 1.2 or len(label) < 15 else label.replace(" (", "\n("), labelpad=3)
    bar.outline.set_linewidth(0.4)  # type: ignore[operator]
    axes.tick_params(length=2, width=0.4, pad=2)


def grey_limits(frames: np.ndarray, ends: tuple[float, float] = ENDS) -> tuple[float, float]:
    """A scale of grey for `frames`, between their percentiles `ends`; it is never empty."""
    low, high = (float(value) for value in np.percentile(frames, ends))
    return (low, high) if high > low else (low - 0.5, low + 0.5)


def largest(values: np.ndarray, percentile: float = ENDS[1]) -> float:
    """Where the colours of differences end: a percentile of the magnitude of `values`."""
    return float(np.percentile(np.abs(values), percentile)) or 1.0


def around_zero(colours: str, limits: tuple[float, float]) -> tuple[str, tuple[float, float]]:
    """The map and the range for values within `limits`, which hold zero: `colours`, which are dark at zero, or those of
    differences, white at zero, where values on either side of it take more than one of them."""
    low, high = limits
    if min(-low, high) > (high - low) / len(palette()):
        most = max(-low, high)
        return SIGNED_MAP, (-most, most)
    return (colours if high >= -low else f"{colours}_r"), limits


def decimal_scale(largest: float) -> tuple[float, str]:
    """The power of ten to divide by, and how a label shows it: 4.1e-7 → (1e-7, "10⁻⁷")."""
    if not np.isfinite(largest) or largest == 0 or 0.1 <= abs(largest) < 1000:
        return 1.0, ""
    exponent = math.floor(math.log10(abs(largest)))
    return 10.0**exponent, "10" + superscript(exponent)


def superscript(exponent: int) -> str:
    """An integer in superscript digits: -7 → "⁻⁷"."""
    return str(exponent).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))


def scientific(value: float | None, digits: int = 3) -> str:
    """A number for people: 4.12e-7 → "4.12 × 10⁻⁷"; None → "–"; infinite → "∞"."""
    if value is None or math.isnan(value):
        return "–"
    if math.isinf(value):
        return "∞" if value > 0 else "−∞"
    if value == 0 or 1e-3 <= abs(value) < 1e5:
        return f"{value:,.0f}".replace("-", "−") if abs(value) >= 999.5 else plain(value, digits).replace("-", "−")
    return in_print(f"{value:.{digits - 1}e}")


def in_print(text: str) -> str:
    """`text` whose numbers have their powers of ten as print has them: "9.1e-19 m³" → "9.1 × 10⁻¹⁹ m³"."""
    return POWER.sub(lambda m: f"{m[1].replace('-', '−')}\u00a0×\u00a010{superscript(int(m[2]))}", text)


@dataclass(frozen=True)
class Block:
    """One figure of the page: image is a `data:` URI, drawn `width` per cent of the page wide, or `live` is what stands
    in its place, as HTML.

    Without either, `caption` says why there is none.
    """

    heading: str
    caption: str
    title: str = ""
    image: str | None = None
    width: int = 100
    number: int | None = None
    live: Markup | None = None

    @property
    def anchor(self) -> str:
        """The heading as the page links to it."""
        return re.sub(r"\W+", "-", self.heading.lower()).strip("-")

    @property
    def paper(self) -> bool:
        """Whether the image is on white paper, also where the page is dark."""
        return self.image is not None and not self.image.startswith("data:image/svg")

    @property
    def drawn(self) -> bool:
        """Whether there is a figure."""
        return self.image is not None or self.live is not None


def drawn_block(heading: str, caption: str, title: str, figure: Figure) -> Block:
    """`figure` in its block."""
    width = round(100 * float(figure.get_figwidth()) / WIDTH)
    return Block(heading, caption.strip(), title, data_uri(figure), width)
