"""Memory that one step of an iteration frees is kept for the next one."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache

M_TRIM_THRESHOLD, M_MMAP_MAX = -1, -4
"""Parameters of glibc's `mallopt`: free memory that is kept [bytes], and arrays that may be mapped one by one."""
KEPT, USUALLY_KEPT = 1 << 30, 1 << 26
MOST_MAPPED = 65536
"""glibc's own default."""


@contextmanager
def memory_kept() -> Iterator[None]:
    """Keep what is freed inside (up to 1 GB), for the same arrays are needed again; give it back at the end.

    Otherwise glibc returns the memory of large arrays to the system after every step, and each of their pages is
    found missing, mapped and zeroed again in the next. Other C libraries are left alone.
    """
    libc = _glibc()
    if libc is None:
        yield
        return
    libc.mallopt(M_MMAP_MAX, 0)
    libc.mallopt(M_TRIM_THRESHOLD, KEPT)
    try:
        yield
    finally:
        libc.mallopt(M_MMAP_MAX, MOST_MAPPED)
        libc.mallopt(M_TRIM_THRESHOLD, USUALLY_KEPT)
        libc.malloc_trim(0)


@cache
def _glibc() -> ctypes.CDLL | None:
    try:
        libc = ctypes.CDLL(None)
        return libc if libc.gnu_get_libc_version and libc.mallopt else None
    except (AttributeError, OSError, TypeError):
        return None
