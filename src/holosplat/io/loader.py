"""The description of a format of scans, an entry of the table in `formats`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ..scan import Scan
    from .raw_file import Opens


@dataclass(frozen=True)
class Loader:
    """One format of scans, recognised by the content of a path.

    name: of the format, for messages.
    mark: description of a path of that format ("a folder with scan.json").
    recognises: whether a path is one, by its content.
    read: the scan at such a path, with the values that it lacks.
    takes: names of these values (energy_kev [keV], distance [m], pixel_size [m], angles_deg [N], flats and darks,
        paths of images; files, the names of images in a folder; entry, of an HDF5 file; black, white).
    opens: opens such a file frame by frame, raw ones with their flats and darks; None where frames are corrected.
    """

    name: str
    mark: str
    recognises: Callable[[Path], bool]
    read: Callable[[Path, Mapping[str, Any]], Scan]
    takes: tuple[str, ...] = ()
    opens: Opens | None = None


def folder_with(*names: str) -> Callable[[Path], bool]:
    """Whether a path is a folder that holds all the files `names`."""
    return lambda path: path.is_dir() and all((path / name).is_file() for name in names)
