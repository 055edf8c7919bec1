"""Memory that one step of a fit frees is kept for the next one."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
"""Parameters of glibc's `mallopt`."""
LARGEST_MMAP_THRESHOLD = 32 << 20
"""What glibc takes at most [bytes]; arrays larger than that are mapped anew whatever we say."""
KEPT = 1 << 30
"""Free memory [bytes] that is not given back while a fit runs."""


@contextmanager
def memory_kept() -> Iterator[None]:
    """Keep what is freed inside, for the same arrays are needed again; give it back at the end.

    Otherwise glibc returns the memory of large arrays to the system after every step, and each of their pages is
    found missing, mapped and zeroed again in the next (up to a sixth of a step). Other C libraries are left alone.
    """
    libc = _glibc()
    if libc is None:
        yield
        return
    libc.mallopt(M_MMAP_THRESHOLD, LARGEST_MMAP_THRESHOLD)
    libc.mallopt(M_TRIM_THRESHOLD, KEPT)
    try:
        yield
    finally:
        libc.mallopt(M_TRIM_THRESHOLD, 2 * LARGEST_MMAP_THRESHOLD)
        libc.malloc_trim(0)


@cache
def _glibc() -> ctypes.CDLL | None:
    try:
        libc = ctypes.CDLL(None)
        return libc if libc.gnu_get_libc_version and libc.mallopt else None
    except (AttributeError, OSError, TypeError):
        return None
