"""How much memory and disk there is for this process, by what limits it: the machine, its container, the shell."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable, Iterator
from pathlib import Path

PROC, CGROUPS = Path("/proc"), Path("/sys/fs/cgroup")
"""Where Linux says what there is."""
UNLIMITED = 1 << 60
"""Bytes from which on a limit is none: the first control groups say nearly 2⁶³ where there is no limit."""


def machine_memory() -> int:
    """Bytes of memory that this process could ever have: of the machine, its control group and its address space."""
    return min([_physical(), *(limit for limit, _ in _groups()), *(limit for limit, _ in _address_space())])


def free_memory() -> int:
    """Bytes of memory that the machine, control group and address space (`ulimit -v`) leave this process; at least
    0."""
    left = [*_left(_groups()), *_left(_address_space())]
    return max(0, min([1024 * _entry(PROC / "meminfo", "MemAvailable:") or _physical(), *left]))


def left_by_limits() -> tuple[int, int]:
    """Bytes of address space, and of memory, that this process' limits leave it; `UNLIMITED` where there is none."""
    space, memory = (min([UNLIMITED, *_left(limits)]) for limits in (_address_space(), _groups()))
    return max(0, space), max(0, memory)


def free_disk(path: str | Path) -> int:
    """Bytes that are free where `path` is, or is to be made."""
    place = Path(os.path.realpath(path))
    while not place.exists() and place != place.parent:
        place = place.parent
    return shutil.disk_usage(place).free


def _left(limits: Iterable[tuple[int, int]]) -> Iterator[int]:
    """What limits leave beside what is used."""
    return (limit - used for limit, used in limits)


def _physical() -> int:
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


def _entry(path: Path, key: str) -> int:
    """The number behind `key` in a file of such lines; 0 where there is none."""
    try:
        lines = path.read_text().splitlines()
    except OSError:
        return 0
    return next((int(line.split()[1]) for line in lines if line.split()[:1] == [key]), 0)


def _groups() -> Iterator[tuple[int, int]]:
    """Limit and use [bytes] of the control groups of this process, of either version, and of those that these are in.

    Memory that only caches files counts as used there, but is given back when it is wanted.
    """
    try:
        lines = (PROC / "self/cgroup").read_text().splitlines()
    except OSError:
        return
    for line in lines:
        number, kinds, name = line.split(":", 2)
        if number == "0":
            yield from _up(CGROUPS, name, "memory.max", "memory.current", "file")
        elif "memory" in kinds.split(","):
            names = ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_cache")
            yield from _up(CGROUPS / "memory", name, *names)


def _up(top: Path, name: str, limit: str, used: str, cache: str) -> Iterator[tuple[int, int]]:
    """Limits and uses of the group `name`, and of all above it; in a container its files may stand at the `top`."""
    place = top / name.lstrip("/")
    for folder in (place, *(p for p in place.parents if p == top or top in p.parents)):
        try:
            most, now = (int((folder / file).read_text()) for file in (limit, used))
        except (OSError, ValueError):  # no such file, or "max"
            continue
        if most < UNLIMITED:
            yield most, max(0, now - _entry(folder / "memory.stat", cache))


def _address_space() -> Iterator[tuple[int, int]]:
    """The limit of this process' address space and what it has taken of it [bytes], where there is a limit."""
    try:
        import resource
    except ImportError:  # Windows
        return
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit != resource.RLIM_INFINITY:
        yield limit, 1024 * _entry(PROC / "self/status", "VmSize:")
