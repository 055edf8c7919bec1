"""Names of half-written files, the removal of those that a killed process leaves, and files flushed to the disk."""

from __future__ import annotations

import os
import re
import secrets
import shutil
import socket
import zlib
from collections.abc import Iterator
from contextlib import nullcontext, suppress
from pathlib import Path

LOCK = ".lock"
"""The file that says who writes to a folder."""
RECORD = "provenance.json"
"""The file of a folder that says which commands wrote there, before anything else is there."""
LONGEST = 180
"""Bytes of a file's name that its temporary name keeps: with what is added it stays below the 255 of file systems."""
PATTERN = re.compile(r"^\..*~(?P<host>[0-9a-f]{8})-(?P<process>[0-9a-f]+)-[0-9a-f]{8}(\.[^.]*)?$", re.DOTALL)


def host() -> str:
    """Eight digits that stand for this machine, and for the container in it."""
    return f"{zlib.crc32(f'{socket.gethostname()} {namespace()}'.encode()):08x}"


def namespace() -> str:
    """What tells numbers of processes from those of other containers of this machine, on Linux; empty elsewhere."""
    try:
        return os.readlink("/proc/self/ns/pid")
    except OSError:
        return ""


def temporary_name(target: Path) -> Path:
    """A new hidden name beside `target` with its suffix, which says which process of which machine writes it."""
    owner = f"{host()}-{os.getpid():x}-{secrets.token_hex(4)}"
    return target.with_name(f".{_kept(target)}~{owner}{target.suffix}")


def is_hidden(path: Path) -> bool:
    """Whether a file or folder has a name that readers of folders pass over: it begins with a dot."""
    return path.name.startswith(".")


def files_in(folder: Path) -> Iterator[Path]:
    """The files below `folder`, but for hidden ones, in order."""
    for above, folders, names in os.walk(folder):
        folders.sort()
        yield from (path for name in sorted(names) if not is_hidden(path := Path(above, name)) and path.is_file())


def is_left(path: Path) -> bool:
    """Whether a name is that of a half-written file, or of a lock."""
    return PATTERN.match(path.name) is not None or path.name == LOCK


def is_begun(folder: Path) -> bool:
    """Whether a folder holds more than what a process that was killed at its start leaves: locks, half-written files,
    and the record of its command."""
    return any(not is_left(found) and found.name != RECORD for found in folder.iterdir())


def clear_leftovers(target: Path) -> None:
    """Remove what processes of this machine that are no more left of `target`; where that fails, nothing is said."""
    with suppress(OSError):
        for found in target.parent.glob(f".{_escaped(_kept(target))}~*"):
            _clear(found)


def clear_all_leftovers(folder: Path) -> None:
    """The same of everything in `folder`."""
    with suppress(OSError):
        for found in folder.iterdir():
            _clear(found)


def is_alive(process: int) -> bool:
    """Whether this machine runs a process of that number."""
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):  # of somebody else; of no process at all
        return True
    return True


def _clear(found: Path) -> None:
    match = PATTERN.match(found.name)
    if match is None or match["host"] != host() or is_alive(int(match["process"], 16)):
        return
    if found.is_dir() and not found.is_symlink():
        shutil.rmtree(found, ignore_errors=True)
    else:
        found.unlink(missing_ok=True)


def _kept(target: Path) -> str:
    """The beginning of a file's name without its suffix, of whole characters."""
    return os.fsdecode(os.fsencode(target.stem)[:LONGEST]).encode("utf-8", "ignore").decode("utf-8", "ignore")


def _escaped(name: str) -> str:
    return re.sub(r"([*?[])", r"[\1]", name)


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
