"""Writing a folder whole or not at all."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ..checks import InputError, require
from .durable import flushed, flushed_tree
from .leftovers import clear_leftovers, is_begun, temporary_name
from .provenance import leave_record


def is_taken(path: str | Path) -> bool:
    """Whether something is at `path`: a file, a broken link, or a folder that is begun (`is_begun`)."""
    target = Path(path)
    return os.path.lexists(target) and (not target.is_dir() or is_begun(target))


def require_new(path: str | Path, way_out: str = "choose another name, or remove it first") -> None:
    """`InputError`, with the advice `way_out`, unless `path` is free (`is_taken`) and lies in an existing folder."""
    require(not is_taken(path), f"{path} must be new or empty, but it holds something already; {way_out}.")
    require_parent(path)


def require_parent(path: str | Path) -> None:
    """`InputError` unless `path` lies in an existing folder."""
    parent = Path(os.path.realpath(path)).parent
    require(parent.is_dir(), f"{path} must lie in an existing folder, but {parent} is none; create it.")


@contextmanager
def atomic_folder(path: str | Path) -> Iterator[Path]:
    """A temporary folder beside `path` to write into; it becomes `path`, which must be new, when the block ends well.

    If the block raises, the temporary folder goes; a failure of the file system becomes an `InputError`.
    """
    require_new(path)
    target = Path(path).resolve()
    clear_leftovers(target)
    temporary = temporary_name(target)
    try:
        temporary.mkdir()
        yield temporary
        leave_record(target, temporary)
        flushed_tree(temporary)
        if target.is_dir():  # one that `is_taken` calls free, which not every system replaces
            shutil.rmtree(target)
        os.rename(temporary, target)
        flushed(target.parent)
    except OSError as error:
        raise InputError(f"{path} must be writable, but writing it failed: {error}.") from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
