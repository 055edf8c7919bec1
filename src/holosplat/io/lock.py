"""One writer of a folder: a lock that says which process of which machine writes there, and that the kernel holds.

The kernel lets go of it when the process ends, however it does, and knows processes of other containers, too. Where a
file system has no such locks, processes of the same machine and namespace are known by their number and beginning.
"""

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
from .atomic import require_parent
from .leftovers import LOCK, clear_all_leftovers, is_alive, namespace, temporary_name

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None


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


_held: dict[Path, int | None] = {}
"""Folders that this process writes already, and the open files that the kernel has locked for it."""


def _let_go() -> None:
    """In a child process: the locks of its parent are not its own, and must not outlive that."""
    for handle in _held.values():
        _close(handle)
    _held.clear()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_let_go)


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
        handle = _take(path / LOCK, folder)
    except OSError as error:
        raise InputError(f"{folder} must be writable, but writing to it failed: {error}.") from error
    _held[path] = handle
    try:
        clear_all_leftovers(path)
        yield
    finally:
        with suppress(OSError):
            (path / LOCK).unlink(missing_ok=True)
        _close(_held.pop(path, None))
        with suppress(OSError):
            path.rmdir()  # which fails unless it is empty


def writer_of(folder: Path) -> Writer | None:
    """Who writes to `folder` by its lock; None where nobody does."""
    lock = Path(folder) / LOCK
    text = _text(lock)
    if text is None:
        return None
    holder = _holder(text)
    number = holder.get("process")
    process = number if isinstance(number, int) else 0
    return Writer(str(holder.get("host", "?")), process, str(holder.get("since", "?")), _is_stale(lock, holder))


def require_unwritten(folder: Path) -> None:
    """`TakenError` where another process writes to `folder`, or may do so."""
    writer = writer_of(folder)
    if writer is not None and not writer.gone:
        raise TakenError(
            f"{folder} must have one writer, but process {writer.process or '?'} on {writer.host} writes to it since "
            f"{writer.since}; wait for its end, or remove {Path(os.path.realpath(folder)) / LOCK} if there is no such "
            "process any more."
        )


def _take(lock: Path, folder: Path) -> int | None:
    """Put a lock of this process there, and give the open file that the kernel has locked, None where it cannot;
    `InputError` where there is a lock of another process."""
    for _ in range(5):
        with suppress(FileExistsError):
            return _placed(lock)
        seen = _text(lock)
        if seen is None:  # it has just gone
            continue
        require_unwritten(folder)
        _remove(lock, seen)
    raise TakenError(f"{folder} must have one writer, but several try to be it; try again.")


def _placed(lock: Path) -> int | None:
    """Write the lock, locked and with its text from the first moment on; `FileExistsError` where there is one."""
    draft = temporary_name(lock)
    handle = _written(draft)
    try:
        os.link(draft, lock)
    except FileExistsError:
        _close(handle)
        raise
    except OSError:  # a file system without links
        _close(handle)
        return _written(lock)
    finally:
        draft.unlink(missing_ok=True)
    return handle


def _written(path: Path) -> int | None:
    """A new file that says who this is: open, where the kernel has locked it for this process, or else closed."""
    handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666)
    try:
        locked = _is_free(handle) is True
        with open(handle, "w", encoding="utf-8", closefd=False) as file:
            file.write(json.dumps(_self() | {"locked": locked}))
    except BaseException:
        _close(handle)
        with suppress(OSError):  # what went wrong before is said, not this
            path.unlink(missing_ok=True)
        raise
    if locked:
        return handle
    _close(handle)
    return None


def _self() -> dict[str, Any]:
    """Who this is."""
    return {
        "host": socket.gethostname(),
        "boot": _boot(),
        "namespace": namespace(),
        "process": os.getpid(),
        "began": _began("self"),
        "since": time.strftime("%Y-%m-%d %H:%M:%S"),
    }


def _is_free(handle: int) -> bool | None:
    """Whether the kernel locks an open file for this process, and no other has it; None where it cannot say."""
    if fcntl is None:
        return None
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # such as ENOLCK, of a file system without locks
        return None
    return True


def _close(handle: int | None) -> None:
    if handle is not None:
        with suppress(OSError):
            os.close(handle)


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
    """What a lock says; None where there is none."""
    if os.path.lexists(lock) and not lock.is_file():  # such as a pipe, which may never end
        return ""
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


def _is_stale(lock: Path, holder: dict[str, Any]) -> bool:
    """Whether the process of a lock was one of this machine and is no more; False where that cannot be told."""
    process, boot = holder.get("process"), holder.get("boot")
    same = holder.get("host") == socket.gethostname() or (isinstance(boot, str) and boot == _boot() != "")
    if not same or not isinstance(process, int):
        return False
    if holder.get("locked") is True and (free := _may_be_locked(lock)) is not None:
        return free
    if holder.get("namespace", namespace()) != namespace() or (boot or _boot()) != _boot():
        return False
    mine = process == os.getpid()
    return (not mine and not is_alive(process)) or holder.get("began") != _began("self" if mine else str(process))


def _may_be_locked(lock: Path) -> bool | None:
    """Whether no process has a lock by the kernel; None where that cannot be told."""
    try:
        handle = os.open(lock, os.O_RDWR)
    except OSError:
        return None
    try:
        return _is_free(handle)
    finally:
        _close(handle)


def _boot() -> str:
    """What tells this run of the machine's kernel from others, on Linux; empty elsewhere."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="utf-8").strip()
    except OSError:
        return ""


def _began(process: str) -> str:
    """When a process began [ticks since the machine did], as Linux says it; empty elsewhere."""
    try:
        text = Path(f"/proc/{process}/stat").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""
    return text.rsplit(")", 1)[1].split()[19]
