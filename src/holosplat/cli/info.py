"""`holosplat info`: what a file or a run is, and what it lacks."""

from __future__ import annotations

from pathlib import Path

from tyro.conf import Positional

from ..io.reading import Reading
from .places import Output


def info(path: Positional[Path], picture: Output | None = None, reading: Reading = Reading()) -> None:
    """Say what a file or a run is: shape, beam, angles, air, noise, fringes, what is missing, and what it takes.

    A few frames are read, and no more. What is missing is said with the option that gives it.

    Args:
        path: Scan of any format, volume, mesh, object or run folder.
        picture: PNG file to write: two frames with a scale bar, and their power spectrum with fringes.
    """
    from ..report.info import info as described

    print("\n".join(described(path, reading, picture).lines()))
