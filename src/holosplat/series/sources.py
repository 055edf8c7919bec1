"""Which scans a series is of."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from ..checks import InputError, require
from ..io.formats import loader_of
from ..io.leftovers import is_hidden


def listed(paths: Sequence[Path]) -> list[Path]:
    """The scans that `paths` name, in order: scans themselves, or folders of scan files, in the order of their names.

    Errors: `InputError` for a folder that is neither a scan nor holds scan files.
    """
    found = list[Path]()
    for path in paths:
        require(path.exists(), f"{path} must be a scan, or a folder of scans, but there is no such path; check it.")
        if path.is_file() or _is_scan(path):
            found.append(path)
            continue
        inside = [each for each in in_order(path) if _is_scan(each)]
        require(bool(inside), f"{path} must be a scan, or a folder of scan files, but it holds none; name another.")
        found += inside
    return found


def in_order(folder: Path) -> list[Path]:
    """The regular files of a folder by name, numbers as numbers; hidden ones and links are passed over."""
    files = [path for path in folder.iterdir() if not is_hidden(path) and not path.is_symlink() and path.is_file()]
    return sorted(files, key=natural)


def natural(path: Path) -> list[tuple[int, int | str]]:
    """A key that sorts scan2 before scan10."""
    words = re.split(r"([0-9]+)", path.name)
    return [(0, int(word)) if word.isascii() and word.isdigit() else (1, word) for word in words]


def _is_scan(path: Path) -> bool:
    try:
        loader_of(path)
    except InputError:
        return False
    return True
