"""Writing a file whole or not at all."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ..checks import InputError, require
from .folder import require_parent


def require_writable(path: str | Path) -> None:
    """`InputError` unless `path` is a place for a file: in an existing folder, and no folder itself."""
    require(not Path(path).is_dir(), f"{path} must be a file to write, but it is a folder; add a file name.")
    require_parent(path)


def require_apart(out: Path, *others: Path) -> None:
    """`InputError` if the file to write is one of `others`, which would be lost."""
    for other in others:
        require(Path(out).resolve() != Path(other).resolve(), f"{out} is read or written already; name another file.")


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """A temporary path beside `path` (same suffix) to write to; it replaces `path` when the block ends well.

    If the block raises, the temporary file goes and `path` stays as it was; a failure of the file system
    itself (no such folder, no permission, disk full) becomes an `InputError`.
    """
    target = Path(os.path.realpath(path))  # of a link, what it points to is replaced
    require_writable(path)
    temporary = target.with_name(f".{target.stem[:64]}-{secrets.token_hex(4)}{target.suffix}")
    try:
        yield temporary
        os.replace(temporary, target)
    except OSError as error:
        raise InputError(f"{path} must be writable, but writing it failed: {error}.") from error
    finally:
        temporary.unlink(missing_ok=True)
