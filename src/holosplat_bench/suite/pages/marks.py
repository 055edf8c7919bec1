"""How methods are told apart in plots: a colour for the family; its shade, a marker and dashes for the method."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from matplotlib.colors import to_rgb, to_rgba
from matplotlib.lines import Line2D

from holosplat.report.style import CYCLE

from .results import CaseResult

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
