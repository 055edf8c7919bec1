"""What a row records of the machine and of the code that made it."""

from __future__ import annotations

import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

STATUS, CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")
RESET_PEAK = "5"
"""What Linux takes to forget the peak of a process's memory (proc(5), clear_refs)."""


def source_commit() -> str:
    """The commit of this package's source tree, with `-dirty` if it was changed; empty outside a git checkout."""
    root = Path(__file__).resolve().parents[3]
    if not (root / ".git").exists():
        return ""
    command = ["git", "describe", "--always", "--dirty", "--abbrev=10", "--exclude=*"]
    try:
        shown = subprocess.run(command, capture_output=True, text=True, check=False, cwd=root)
    except OSError:  # git is not installed
        return ""
    return shown.stdout.strip()


@contextmanager
def memory_growth() -> Iterator[Callable[[], int | None]]:
    """Yields a function: by how many bytes the process's memory grew at its peak since; None where Linux is not."""
    before = None
    with suppress(OSError):
        CLEAR.write_text(RESET_PEAK)
        before = _status("VmRSS")

    def growth() -> int | None:
        peak = _status("VmHWM")
        return None if before is None or peak is None else max(0, peak - before)

    yield growth


def _status(key: str) -> int | None:
    """An entry of /proc/self/status [bytes]."""
    try:
        lines = STATUS.read_text(encoding="ascii", errors="replace").splitlines()
        return 1024 * next(int(line.split()[1]) for line in lines if line.startswith(key + ":"))
    except (OSError, StopIteration):
        return None
