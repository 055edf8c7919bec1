"""One writer of a folder: a lock that says which process of which machine writes there."""

from __future__ import annotations

import json
import os
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..checks import InputError
from .folder import require_parent
from .leftovers import LOCK, clear_all_leftovers, is_alive, temporary_name


class TakenError(InputError):
    """Another process writes to the folder."""


@dataclass(frozen=True)
class Writer:
    """Who writes to a folder: its machine and process, since when; gone: whether it was of this machine and is no
    more."""

    host: str
    process: int
    since: str
    gone: bool


_held: set[Path] = set()
"""Folders that this process writes already."""


@contextmanager
def sole_writer(folder: Path) -> Iterator[None]:
    """Keep other processes from writing to `folder`, which is made if need be, until the block ends.

    The lock of a process that is no more is taken over if it was of this machine, and its half-written files go. A
    folder that is empty in the end goes, too. Errors: `InputError` where another process writes, where that
    of another machine may do so, and where the folder cannot be written.
    """
    path = Path(os.path.realpath(folder))
    if path in _held:  # a step of this process within another one
        yield
        return
    require_parent(folder)
    try:
        path.mkdir(exist_ok=True)
        _take(path / LOCK, folder)
    except OSError as error:
        raise InputError(f"{folder} must be writable, but writing to it failed: {error}.") from error
    _held.add(path)
    try:
        clear_all_leftovers(path)
        yield
    finally:
        _held.discard(path)
        with suppress(OSError):
            (path / LOCK).unlink(missing_ok=True)
            path.rmdir()  # which fails unless it is empty


def writer_of(folder: Path) -> Writer | None:
    """Who writes to `folder` by its lock; None where nobody does."""
    text = _text(Path(folder) / LOCK)
    if text is None:
        return None
    holder = _holder(text)
    number = holder.get("process")
    process = number if isinstance(number, int) else 0
    return Writer(str(holder.get("host", "?")), process, str(holder.get("since", "?")), _is_stale(holder))


def _take(lock: Path, folder: Path) -> None:
    """Put a lock of this process there; `InputError` where there is one of another process."""
    for _ in range(5):
        if _placed(lock):
            return
        seen = _text(lock)
        if seen is None:  # it has just gone
            continue
        holder = _holder(seen)
        if not _is_stale(holder):
            where = f"process {holder.get('process', '?')} on {holder.get('host', 'an unknown machine')}"
            raise TakenError(
                f"{folder} must have one writer, but {where} writes to it since {holder.get('since', '?')}; wait for "
                f"its end, or remove {lock} if there is no such process any more."
            )
        _remove(lock, seen)
    raise TakenError(f"{folder} must have one writer, but several try to be it; try again.")


def _placed(lock: Path) -> bool:
    """Write the lock, with its text from the first moment on; False where there is one."""
    text = json.dumps(
        {
            "host": socket.gethostname(),
            "process": os.getpid(),
            "began": _began(os.getpid()),
            "since": time.strftime("%Y-%m-%d %H:%M:%S"),
        }
    )
    draft = temporary_name(lock)
    draft.write_text(text, encoding="utf-8")
    try:
        os.link(draft, lock)
    except FileExistsError:
        return False
    except OSError:  # a file system without links
        return _opened(lock, text)
    finally:
        draft.unlink(missing_ok=True)
    return True


def _opened(lock: Path, text: str) -> bool:
    try:
        with lock.open("x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError:
        return False
    return True


def _remove(lock: Path, seen: str) -> None:
    """Remove the lock whose text is `seen`, and none that has taken its place."""
    aside = temporary_name(lock)
    with suppress(FileNotFoundError):
        os.rename(lock, aside)
        if _text(aside) != seen:
            with suppress(FileExistsError):
                os.link(aside, lock)
        aside.unlink(missing_ok=True)


def _text(lock: Path) -> str | None:
    try:
        return lock.read_text(encoding="utf-8", errors="replace")
    except FileNotFoundError:
        return None


def _holder(text: str) -> dict[str, Any]:
    try:
        found = json.loads(text)
    except ValueError:
        found = None
    return found if isinstance(found, dict) else {}


def _is_stale(holder: dict[str, Any]) -> bool:
    """Whether the process of a lock was one of this machine and is no more."""
    process = holder.get("process")
    if holder.get("host") != socket.gethostname() or not isinstance(process, int):
        return False
    return (process != os.getpid() and not is_alive(process)) or holder.get("began") != _began(process)


def _began(process: int) -> str:
    """When a process began [ticks since the machine did], as Linux says it; empty elsewhere."""
    try:
        text = Path(f"/proc/{process}/stat").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""
    return text.rsplit(")", 1)[1].split()[19]
