"""Reports whose figures are made but not drawn: drawing is most of what a small run takes."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import pytest
from matplotlib.figure import Figure

from holosplat.report.surface import SurfaceImage, render_surface

COARSE = 24
"""Pixels along an edge of a surface's picture."""
BLANK = "data:image/svg+xml;base64,PHN2ZyB4bWxucz0iaHR0cDovL3d3dy53My5vcmcvMjAwMC9zdmciLz4="


def _blank(figure: Figure, kind: str) -> str:
    assert figure.axes
    assert kind in ("svg", "png")
    return BLANK


def _coarse(values, grid, level, rotation, size, colour) -> SurfaceImage:
    return render_surface(values, grid, level, rotation, COARSE, colour)


@contextlib.contextmanager
def undrawn() -> Iterator[None]:
    """Within, the figures of reports are blank in the page, and surfaces are traced coarsely.

    All else of a report is as ever. tests/report draws, and so do the runs that the tests of the commands share.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("holosplat.report.block.data_uri", _blank)
        patch.setattr("holosplat.report.figures.render_surface", _coarse)
        patch.setattr("holosplat.report.motion_blocks.animation", lambda moving: b"still")
        yield
