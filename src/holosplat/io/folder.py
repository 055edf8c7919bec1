"""Writing a folder whole or not at all."""

from __future__ import annotations

import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ..checks import InputError, require


def require_new(path: str | Path) -> None:
    """`InputError` unless `path` is free (nothing there, or an empty folder) and lies in an existing folder."""
    target = Path(path)
    taken = os.path.lexists(target) and (not target.is_dir() or any(target.iterdir()))
    require(not taken, f"{path} must be new, but it is there already; choose another name, or remove it first.")
    parent = target.resolve().parent
    require(parent.is_dir(), f"{path} must lie in an existing folder, but {parent} is none; create it.")


@contextmanager
def atomic_folder(path: str | Path) -> Iterator[Path]:
    """A temporary folder beside `path` to write into; it becomes `path`, which must be new, when the block ends well.

    If the block raises, the temporary folder goes; a failure of the file system becomes an `InputError`.
    """
    require_new(path)
    target = Path(path).resolve()
    temporary = target.with_name(f".{target.name[:64]}-{secrets.token_hex(4)}")
    try:
        temporary.mkdir()
        yield temporary
        if target.is_dir():  # an empty one, which not every system replaces
            target.rmdir()
        os.rename(temporary, target)
    except OSError as error:
        raise InputError(f"{path} must be writable, but writing it failed: {error}.") from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
