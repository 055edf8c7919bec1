"""Memory that one step of an iteration frees is kept for the next one; and none is searched for garbage in vain."""

from __future__ import annotations

import ctypes
import gc
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD, M_MMAP_MAX = -1, -3, -4
"""Parameters of glibc's `mallopt`."""
INSIDE = {M_MMAP_MAX: 0, M_TRIM_THRESHOLD: -1}
"""No array is mapped on its own, and all free memory is kept: a step on frames of 1024² pixels frees gigabytes."""
OUTSIDE = {M_MMAP_MAX: 65536, M_MMAP_THRESHOLD: 1 << 25, M_TRIM_THRESHOLD: 1 << 26}
"""The size to which glibc's thresholds grow by themselves where large arrays come and go."""

_lock, _depth = threading.Lock(), 0


@contextmanager
def memory_kept() -> Iterator[None]:
    """Keep memory that is freed inside for the next arrays of the same sizes; return it at the end of the outermost
    block.

    Otherwise glibc returns the memory of large arrays to the system after every step, and each of their pages is
    found missing, mapped and zeroed again in the next. Other C libraries are left alone.
    """
    _count(1, INSIDE)
    try:
        yield
    finally:
        _count(-1, OUTSIDE)


@contextmanager
def uncollected() -> Iterator[None]:
    """Search for no garbage inside, where large libraries are loaded: they are none, and the search takes as long as a
    fifth of their loading."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def _count(change: int, settings: dict[int, int]) -> None:
    """Enter or leave a block; the settings are made where the outermost one begins or ends."""
    global _depth
    libc = _glibc()
    with _lock:
        outermost = _depth == 0 or _depth + change == 0
        _depth += change
        if libc is None or not outermost:
            return
        for parameter, value in settings.items():
            libc.mallopt(parameter, value)
        if change < 0:
            libc.malloc_trim(0)


@cache
def _glibc() -> ctypes.CDLL | None:
    try:
        libc = ctypes.CDLL(None)
        return libc if libc.gnu_get_libc_version and libc.mallopt else None
    except (AttributeError, OSError, TypeError):
        return None
