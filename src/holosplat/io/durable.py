"""Files that are on the disk, not on their way to it."""

from __future__ import annotations

import os
from contextlib import nullcontext, suppress
from pathlib import Path


def flushed(path: Path) -> None:
    """Wait until a file, or the names in a folder, are on the disk (fsync); `OSError` where the disk fails.

    Some network file systems refuse this for folders, which is no failure.
    """
    handle = os.open(path, os.O_RDONLY)
    try:
        with suppress(OSError) if path.is_dir() else nullcontext():
            os.fsync(handle)
    finally:
        os.close(handle)


def flushed_tree(folder: Path) -> None:
    """The same of all files and folders in `folder`."""
    for path, _, files in os.walk(folder):
        for name in files:
            flushed(Path(path, name))
        flushed(Path(path))
