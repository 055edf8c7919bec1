"""Files that appear in a folder: which are there, and which of them are complete."""

from __future__ import annotations

import os
import stat
from dataclasses import dataclass, field
from fnmatch import fnmatch
from pathlib import Path

from ..io.leftovers import is_hidden
from .sources import natural


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
