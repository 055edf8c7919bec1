"""`holosplat info`: what a file or a run is, and what it lacks."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from tyro.conf import Positional

from ..checks import InputError, require
from ..io.reading import Reading
from .places import Output

if TYPE_CHECKING:
    from ..io.facts import Facts


def info(path: Positional[Path], picture: Output | None = None, reading: Reading = Reading()) -> None:
    """Say what a file or a run is: shape, beam, angles, air, noise, fringes, what is missing, and what it takes.

    A few frames are read, and no more. What is missing is said with the option that gives it.

    Args:
        path: Scan of any format, volume, mesh, object or run folder.
        picture: PNG file to write: two frames with a scale bar, and their power spectrum with fringes.
    """
    from ..io.facts import facts_of_matter, no_kind
    from ..workflows.run_facts import facts_of_run
    from ..workflows.run_folder import RunFolder

    require(path.exists(), f"{path} must be a file or a folder, but there is nothing; check the path.")
    if picture is not None:
        _require_png(picture)
    try:
        found = facts_of_run(RunFolder(path)) if RunFolder(path).config.is_file() else facts_of_matter(path)
        drawn = picture is not None and found is None
        found = found or _of_scan(path, picture, reading)
    except InputError as error:
        found, drawn = no_kind(path, error), False
    for line in found.lines():
        print(line)
    require(drawn or picture is None, f"--picture is of the frames of a scan, but {path} shows none; leave it.")


def _require_png(picture: Path) -> None:
    from ..io.atomic import require_writable

    require(picture.suffix.lower() == ".png", f"--picture must be a .png file, but it is {picture}; name another.")
    require_writable(picture)


def _of_scan(path: Path, picture: Path | None, reading: Reading) -> Facts:
    """What is said of a scan, and its picture."""
    from ..planning.scan_facts import facts_of_scan

    found = facts_of_scan(path, reading)
    if picture is not None:
        from ..io.atomic import atomic_path
        from ..report.look import look_figure

        with atomic_path(picture) as temporary:
            look_figure(found).savefig(temporary, format="png")
    return found.facts
