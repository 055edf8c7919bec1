"""Half-written files: their names, their removal after a killed process, and their way to the disk. One writer of a
folder: a lock that says which process of which machine writes there, and that the kernel holds.

The kernel lets go of the lock when the process ends, however it does, and knows processes of other containers, too.
Where a file system has no such locks, processes of the same machine and namespace are known by their number and
beginning.
"""

from __future__ import annotations

import glob
import json
import os
import re
import secrets
import shutil
import socket
import time
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..checks import InputError, require

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

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
    """Whether a folder holds more than locks, half-written files and the record of a command that was killed."""
    return any(not is_left(found) and found.name != RECORD for found in folder.iterdir())


def clear_leftovers(target: Path) -> None:
    """Remove what processes of this machine that are no more left of `target`; where that fails, nothing is said."""
    with suppress(OSError):
        for found in target.parent.glob(f".{glob.escape(_kept(target))}~*"):
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


def flushed(path: Path) -> None:
    """Wait until a file, or the names in a folder if its file system can, are on the disk (fsync); `OSError` if it
    fails."""
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


def require_parent(path: str | Path) -> None:
    """`InputError` unless `path` lies in an existing folder."""
    parent = Path(os.path.realpath(path)).parent
    require(parent.is_dir(), f"{path} must lie in an existing folder, but {parent} is none; create it.")


class TakenError(InputError):
    """Another process writes to the folder."""


@dataclass(frozen=True)
class Writer:
    """Who writes to a folder, since when; gone: whether it was a process of this machine that has ended."""

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
        with suppress(OSError):
            for found in path.iterdir():
                _clear(found)
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
    try:
        holder = json.loads(text)
    except ValueError:
        holder = None
    holder = holder if isinstance(holder, dict) else {}
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
    """Lock `folder`: the open file that the kernel locks, None where it cannot; `InputError` if it is taken."""
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


def _is_stale(lock: Path, holder: dict[str, Any]) -> bool:
    """Whether the process of a lock was one of this machine and is no more; False where that cannot be told."""
    process, boot = holder.get("process"), holder.get("boot")
    same = holder.get("host") == socket.gethostname() or (isinstance(boot, str) and boot == _boot() != "")
    if not same or not isinstance(process, int):
        return False
    if holder.get("locked") is True:
        with suppress(OSError):
            handle = os.open(lock, os.O_RDWR)
            free = _is_free(handle)
            _close(handle)
            if free is not None:
                return free
    if holder.get("namespace", namespace()) != namespace() or (boot or _boot()) != _boot():
        return False
    mine = process == os.getpid()
    return (not mine and not is_alive(process)) or holder.get("began") != _began("self" if mine else str(process))


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
