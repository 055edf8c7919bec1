"""What a row records of the machine and of the code that made it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

STATUS, CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")
RESET_PEAK = "5"
"""What Linux takes to forget the peak of a process's memory (proc(5), clear_refs)."""


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
