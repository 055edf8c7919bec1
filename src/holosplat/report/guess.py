"""The guess of a network before the fit, its spread, and its difference from the result."""

from __future__ import annotations

from matplotlib.figure import Figure

from ..units import in_percent
from ..volume import Volume
from .block import Block, drawn_block
from .figures import plane_sizes, richest_planes, slice_row, slice_titles
from .guess_shown import UNSURE, GuessShown
from .style import DELTA_MAP, PanelGrid, styled

SPREAD_MAP = "magma"
MOST_SPREAD = 0.5
"""Largest standard deviation of values between 0 and 1."""


WITHOUT_EACH = "without one of the views each: where it is large, few frames say what is there"
OF_COPIES = (
    "of the same scene mirrored and turned, for one of two views alone says too little: where it is large, the network "
    "guesses what the frames do not say; where it is small, it may err in all of them alike"
)
"""What guesses the spread is of."""


def guess_block(shown: GuessShown) -> Block:
    """The figure with its caption."""
    text = f"{shown.words} a to c, the occupancy that the network guessed; "
    if shown.spread is None or shown.unsure is None:
        text += "d to f, that of the reconstruction. Where it is guessed, this run did not keep."
    else:
        text += (
            f"d to f, the standard deviation of guesses {OF_COPIES if shown.of_copies else WITHOUT_EACH}. g to i, the "
            "occupancy of the reconstruction. "
            f"{in_percent(shown.unsure)} of its matter lies where guesses differ by more than {UNSURE:g}. There it may "
            "be a guess also after the fit, for other matter might explain the frames as well."
        )
    return drawn_block("What was guessed", text, "A network's guess, and its spread.", guess_figure(shown))


@styled
def guess_figure(shown: GuessShown) -> Figure:
    """Guess, spread and reconstruction in the three planes with most of the guessed matter."""
    planes = richest_planes(Volume(shown.occupancy, shown.occupancy, shown.grid))
    rows = [("Guess", shown.occupancy, DELTA_MAP, 1.0)]
    if shown.spread is not None:
        rows.append(("Spread", shown.spread, SPREAD_MAP, MOST_SPREAD))
    rows.append(("Reconstruction", shown.found, DELTA_MAP, 1.0))
    panels = PanelGrid(len(rows), *plane_sizes(shown.grid), (2,))
    for row, (name, values, colours, most) in enumerate(rows):
        drawn = slice_row(panels.axes[row], values, shown.grid, planes, colours, (0.0, most))
        slice_titles(panels.axes[row], 3 * row, name, shown.grid, planes)
        label = "standard deviation" if name == "Spread" else "occupancy"
        panels.bar(drawn, 2, (row, row), label, "max" if name == "Reconstruction" else "neither")
    return panels.figure
