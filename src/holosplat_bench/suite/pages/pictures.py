"""The pictures of a benchmark: the same slices and the same held-out hologram of every method, side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from holosplat.report.style import (
    DELTA_MAP,
    HOLOGRAM_MAP,
    SIGNED_MAP,
    WIDTH,
    colour_bar,
    grey_limits,
    image_panel,
    new_figure,
    scale_bar,
    styled,
)

MOST_COLUMNS, FEWEST_COLUMNS = 6, 4
TITLE, GAP, EDGE = 0.31, 0.06, 0.04  # inches
Arrays = Mapping[str, np.ndarray]


@dataclass(frozen=True)
class Shown:
    """A picture of a method or reference, and the line below its name."""

    name: str
    note: str
    arrays: Arrays


class Tiles:
    """Tiles of equal size in rows: a title and several panels each, one below the other.

    count: of tiles; aspects: height over width of each panel of a tile.
    """

    def __init__(self, count: int, aspects: Sequence[float]) -> None:
        self._bands = -(-count // MOST_COLUMNS)
        self._columns = max(FEWEST_COLUMNS, -(-count // self._bands))  # as many in every row, as far as it goes
        self._width = (WIDTH - 2 * EDGE - (self._columns - 1) * GAP) / self._columns
        self._heights = [aspect * self._width for aspect in aspects]
        self._band = TITLE + sum(self._heights) + GAP * len(aspects)
        self._height = self._bands * self._band + EDGE
        self.figure = new_figure(WIDTH, self._height, "none")

    def tile(self, index: int, name: str, note: str, bold: bool = False) -> list[Axes]:
        """The panels of a tile, titled `name` and, in a second line, `note`."""
        band, column = divmod(index, self._columns)
        left = EDGE + column * (self._width + GAP)
        top = self._height - band * self._band - TITLE
        weight = "bold" if bold else "normal"
        self._write(left, top + 0.155, name, weight)
        self._write(left, top + 0.04, note, "normal")
        panels = []
        for height in self._heights:
            panels.append(self.place(left, top - height, self._width, height))
            top -= height + GAP
        return panels

    def place(self, left: float, bottom: float, width: float, height: float) -> Axes:
        """Axes at a place in inches."""
        return self.figure.add_axes((left / WIDTH, bottom / self._height, width / WIDTH, height / self._height))

    def beside(self, panel: Axes, left: float, width: float, height: float) -> Axes:
        """Axes inside the area of `panel`, as parts of it."""
        box = panel.get_position()
        return self.figure.add_axes((box.x0 + left * box.width, box.y0, width * box.width, height * box.height))

    def _write(self, left: float, bottom: float, text: str, weight: str) -> None:
        self.figure.text(left / WIDTH, bottom / self._height, text, fontsize=6.5, fontweight=weight, va="bottom")


@styled
def slices_figure(truth: Arrays, shown: Sequence[Shown]) -> Figure:
    """δ of the truth and of every method in two planes, across the rotation axis (xz) and along it (xy).

    truth, shown: arrays of `bench.pictures`; all share the truth's colour scale.
    """
    edge = dict(zip("xyz", truth["voxel_size"]))
    sizes = {plane: _size(truth[plane], edge[plane[0]], edge[plane[1]]) for plane in ("xz", "xy")}
    tiles = Tiles(len(shown) + 2, [height / width for width, height in sizes.values()])
    top = float(max(truth[plane].max() for plane in sizes))
    limits = (0.0, 1.15 * top)
    drawn = None
    for index, picture in enumerate([Shown("truth", "", truth), *shown]):
        panels = tiles.tile(index, picture.name, picture.note, bold=index == 0)
        for panel, plane in zip(panels, sizes):
            pitch = (float(edge[plane[0]]), float(edge[plane[1]]))
            drawn = image_panel(panel, picture.arrays[plane].astype(np.float32), pitch, DELTA_MAP, limits)
            if picture.arrays is truth and plane == "xz":
                scale_bar(panel, sizes[plane][0], height=0.08, beside=True)
    panels = tiles.tile((len(shown) + 1), "", "")
    for panel in panels:
        panel.set_axis_off()
    if drawn is not None:
        colour_bar(tiles.figure, drawn, tiles.beside(panels[0], 0.02, 0.07, 0.94), "δ, the material's = 1", "both")
    return tiles.figure


@styled
def holograms_figure(truth: Arrays, shown: Sequence[Shown]) -> Figure:
    """The measured held-out frame; what every method predicts of it, and below that, predicted - measured."""
    measured = truth["frame"].astype(np.float32)
    height, width = measured.shape
    pitch = (float(truth["pixel_size"]), float(truth["pixel_size"]))
    tiles = Tiles(len(shown) + 1, [height / width] * 2)
    limits = grey_limits(measured)
    residuals = [picture.arrays["frame"].astype(np.float32) - measured for picture in shown]
    extremes = [float(np.percentile(np.abs(residual), 99.5)) for residual in residuals]
    limit = float(np.median(extremes)) or 1.0 if extremes else 1.0
    first, below = tiles.tile(0, "measured", "", bold=True)
    grey = image_panel(first, measured, pitch, HOLOGRAM_MAP, limits)
    scale_bar(first, width * pitch[0], height=0.08, beside=True)
    below.set_axis_off()
    signed = None
    for index, (picture, residual) in enumerate(zip(shown, residuals), start=1):
        panels = tiles.tile(index, picture.name, picture.note)
        image_panel(panels[0], picture.arrays["frame"].astype(np.float32), pitch, HOLOGRAM_MAP, limits)
        signed = image_panel(panels[1], residual, pitch, SIGNED_MAP, (-limit, limit))
    colour_bar(tiles.figure, grey, tiles.beside(below, 0.02, 0.07, 0.94), "intensity", "both")
    if signed is not None:
        colour_bar(tiles.figure, signed, tiles.beside(below, 0.54, 0.07, 0.94), "difference", "both")
    return tiles.figure


def _size(image: np.ndarray, across: float, down: float) -> tuple[float, float]:
    """Width and height [m] of an image of that pitch."""
    return image.shape[1] * across, image.shape[0] * down
