"""Pages of TIFF files that nobody vouches for: they hold what they declare, and no more."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ..checks import InputError, require
from .guard import RATIO, SMALL, require_declared, require_inflated, require_memory

DEFLATE = (8, 32946)
"""TIFF's numbers of deflate, of which there are two."""


def page_values(page: Any, file: Path) -> np.ndarray:
    """The values of a page of an open TIFF file, after a look at what it declares."""
    label = f"{file}: an image of {'x'.join(map(str, page.shape))}"
    declared = int(np.prod(page.shape, dtype=object)) * np.dtype(page.dtype or "u1").itemsize
    require_memory(label, declared)
    require_declared(label, declared, file.stat().st_size)
    if int(page.compression) in DEFLATE:
        _require_segments(page, label, declared)
    return page.asarray()


def pages_in(opened: Any, file: Path) -> Iterator[Any]:
    """The pages of an open TIFF file; `InputError` where they run in a circle."""
    places = set[int]()
    while True:
        try:
            page = opened.pages[len(places)]
        except IndexError:
            return
        require(page.offset not in places, f"{file} must hold its pages one after another, but they run in a circle.")
        places.add(page.offset)
        yield page


def all_pages(file: Path) -> list[np.ndarray]:
    """The values of all pages of a TIFF file. Errors: `InputError` for one that is damaged or none."""
    import tifffile

    try:
        with tifffile.TiffFile(file) as opened:
            return [page_values(page, file) for page in pages_in(opened, file)]
    except (InputError, MemoryError):
        raise
    except Exception as error:  # tifffile raises many kinds for damaged files
        raise InputError(f"{file} must be a complete TIFF file, but it is damaged or none: {error}.") from None


def _require_segments(page: Any, label: str, declared: int) -> None:
    """Strips and tiles of a page unpack to no more than the page declares (tiles have margins: twice that)."""
    handle = page.parent.filehandle
    for offset, size in zip(page.dataoffsets, page.databytecounts):
        if size * RATIO > max(SMALL, 2 * declared):
            handle.seek(offset)
            require_inflated(label, handle.read(size), max(SMALL, 2 * declared))
