"""Reports whose figures are made once a file of tests, and not drawn: they are most of what a small run takes."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator
from functools import wraps
from typing import Any

import pytest
from matplotlib.figure import Figure

from holosplat.report import blocks
from holosplat.report.style import WIDTH
from holosplat.report.surface import SurfaceImage, render_surface

COARSE = 24
"""Pixels along an edge of a surface's picture."""
BLANK = "data:image/svg+xml;base64,PHN2ZyB4bWxucz0iaHR0cDovL3d3dy53My5vcmcvMjAwMC9zdmciLz4="


def _blank(figure: Figure, kind: str = "svg") -> str:
    assert figure.axes
    assert kind in ("svg", "png")
    return BLANK


def _coarse(values, grid, level, rotation, size, colour) -> SurfaceImage:
    return render_surface(values, grid, level, rotation, COARSE, colour)


FIGURES = ("scene", "held_out", "explained", "light", "projections", "slices", "correlation")
"""Figures of a report that are never left out, once their block has something to show."""
_made = set[tuple[str, str]]()


def _empty(*_: Any, **__: Any) -> Figure:
    """With axes that show nothing."""
    figure = Figure(figsize=(WIDTH, 1))
    figure.add_axes((0, 0, 1, 1))
    return figure


def _once(name: str, make: Callable[..., Figure]) -> Callable[..., Figure]:
    """`make` for the first report of each file of tests, and a figure with empty axes for the others."""

    @wraps(make)
    def made(*arguments: Any, **options: Any) -> Figure:
        place = (os.environ.get("PYTEST_CURRENT_TEST", "").partition("::")[0], name)
        if place not in _made:
            _made.add(place)
            return make(*arguments, **options)
        return _empty()

    return made


@contextlib.contextmanager
def undrawn(first: bool = True) -> Iterator[None]:
    """Within, the figures of reports are blank in the page, surfaces are traced coarsely, and each kind of figure is
    made for the first report of a file of tests; `first=False`: for none.

    All else of a report is as ever. tests/report draws, and so do the runs that the tests of the commands share.
    """
    with pytest.MonkeyPatch.context() as patch:
        for name in (f"{figure}_figure" for figure in FIGURES):
            patch.setattr(blocks, name, _once(name, getattr(blocks, name)) if first else _empty)
        patch.setattr("holosplat.report.style.data_uri", _blank)
        patch.setattr("holosplat.report.figures.render_surface", _coarse)
        patch.setattr("holosplat.report.moving_figures.animation", lambda moving: b"still")
        yield
