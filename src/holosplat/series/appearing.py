"""Scan files in folders: lists of them, new ones, and whether they are complete."""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatch
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


@dataclass(frozen=True)
class Found:
    """A file as it was when it was looked at: its size, and when it was changed [ns]."""

    path: Path
    size: int
    changed: int

    @property
    def key(self) -> tuple[str, int, int]:
        """What makes it another one: name, size and time of the change."""
        return self.path.name, self.size, self.changed


@dataclass
class Folder:
    """Regular files in `path` whose names fit `pattern`, links and hidden names apart; a file is complete once it has
    stayed as it is for `settle` seconds: a copy that is under way grows, and a rename brings a whole file."""

    path: Path
    pattern: str = "*"
    settle: float = 2.0
    _since: dict[tuple[str, int, int], float] = field(default_factory=dict)

    def complete(self, now: float) -> list[Found]:
        """The complete files by name, at the time `now` [s] of any clock that goes on."""
        there = {found.key: found for found in self._look()}
        self._since = {key: self._since.get(key, now) for key in there}
        ready = [there[key] for key, since in self._since.items() if now - since >= self.settle]
        return sorted(ready, key=lambda found: natural(found.path))

    def _look(self) -> list[Found]:
        found = []
        with os.scandir(self.path) as entries:
            for entry in entries:
                path = Path(entry.path)
                if is_hidden(path) or not fnmatch(entry.name, self.pattern):
                    continue
                try:
                    seen = entry.stat(follow_symlinks=False)
                except OSError:  # gone since
                    continue
                if stat.S_ISREG(seen.st_mode):
                    found.append(Found(path, seen.st_size, seen.st_mtime_ns))
        return found
