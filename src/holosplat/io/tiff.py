"""Scans from and to TIFF files (float32) beside a `scan.json` of how each frame was taken (docs/converting.md)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Literal

import numpy as np

from ..checks import finite, require
from ..scan import Scan
from .atomic import atomic_folder
from .json import write_json
from .raw_file import Loader
from .stacks import all_images
from .table import Table, beam_table, exposure_table, read_exposures

FORMAT = "holosplat TIFF 1"
SCAN = "scan.json"
STACK = "frames.tif"

TiffLayout = Literal["stack", "files"]


def write_tiff(path: str | Path, scan: Scan, layout: TiffLayout = "stack") -> None:
    """Write `scan` as a folder: all frames as pages of frames.tif, or one file a frame, and scan.json."""
    import tifffile

    entries = [{**exposure_table(scan.exposures, n), "test": bool(scan.is_test[n])} for n in range(len(scan))]
    with atomic_folder(path) as folder:
        if layout == "stack":
            tifffile.imwrite(folder / STACK, scan.frames, photometric="minisblack", metadata=None)
        else:
            for n, (frame, entry) in enumerate(zip(scan.frames, entries)):
                entry["file"] = f"frame_{n:04d}.tif"
                tifffile.imwrite(folder / entry["file"], frame, photometric="minisblack", metadata=None)
        pages = {"file": STACK} if layout == "stack" else {}
        write_json(folder / SCAN, {"format": FORMAT, **beam_table(scan), **pages, "frames": entries})


def read_tiff(path: str | Path) -> Scan:
    """The scan of a folder with scan.json and the TIFF files that it names: one of many pages, or one a frame."""
    table = Table.read(Path(path) / SCAN)
    table.require_format(FORMAT)
    entries = table.tables("frames")
    require(len(entries) > 0, f"{table.label('frames')} must hold at least one frame, but it holds none.")
    if "file" in table:
        frames = _pages(table.file("file"), len(entries))
    else:
        frames = [_pages(entry.file("file"), 1)[0] for entry in entries]
    h, w = frames[0].shape
    for entry, frame in zip(entries, frames):
        where = entry.where.rstrip(".")
        require(
            frame.shape == (h, w),
            f"{table.path}: the image of {where} must have {(h, w)} pixels as the first, but it has {frame.shape}.",
        )
        finite(f"{table.path}: the image of {where}", frame)
    is_test = np.array(["test" in entry and entry.flag("test") for entry in entries])
    return Scan(np.stack(frames), read_exposures(table, entries, (h, w)), is_test, table.texts("provenance"))


def _pages(file: Path, count: int) -> list[np.ndarray]:
    """The `count` pages of a TIFF file, each [H, W]."""
    pages = all_images(file)
    require(len(pages) == count, f"{file} must hold {count} pages, one a frame, but it holds {len(pages)}.")
    for page in pages:
        grey = page.ndim == 2 and page.dtype.kind in "iuf"
        require(grey, f"{file} must hold grey images of numbers, but one is {page.dtype} of the shape {page.shape}.")
    return pages


def _recognises(path: Path) -> bool:
    """The folder, or in it scan.json or an image."""
    named = path.name == SCAN or path.suffix.lower() in (".tif", ".tiff")
    return (_folder(path) / SCAN).is_file() and (path.is_dir() or named)


def _folder(path: Path) -> Path:
    return path if path.is_dir() else path.parent


def _read(path: Path, given: Mapping[str, float]) -> Scan:
    return read_tiff(_folder(path))


LOADER = Loader("tiff", f"a folder with {SCAN}, or an image in it", _recognises, _read)
