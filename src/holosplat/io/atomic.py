"""Files and folders written whole or not at all, so that they are there after a crash, too; JSON tables among them."""

from __future__ import annotations

import csv
import io
import json
import os
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from ..checks import InputError, require
from ..tables import read_table
from .lock import clear_leftovers, flushed, flushed_tree, is_begun, require_parent, temporary_name
from .provenance import leave_record, require_free


def require_writable(path: str | Path) -> None:
    """`InputError` unless `path` is a place for a file: in an existing folder, and no folder, pipe or device itself."""
    place = Path(path)
    require(not place.is_dir(), f"{path} must be a file to write, but it is a folder; add a file name.")
    require(
        place.is_file() or not place.exists(),
        f"{path} must be a file to write, but it is a pipe or a device, which would be gone; name a file.",
    )
    require_parent(path)


def require_apart(out: Path, *others: Path) -> None:
    """`InputError` if the file to write is one of `others`, which would be lost."""
    for other in others:
        require(Path(out).resolve() != Path(other).resolve(), f"{out} is read or written already; name another file.")


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """A temporary path beside `path` (same suffix) to write to; it replaces `path` when the block ends well.

    Its bytes are on the disk before it does (fsync), and so is its name afterwards. If the block raises, the temporary
    file goes and `path` stays as it was; a failure of the file system itself (no such folder, no permission, disk full)
    becomes an `InputError`. What a killed process left of the same file goes, too. Commands replace no file without
    --force, and say where each comes from (`provenance`).
    """
    target = Path(os.path.realpath(path))  # of a link, what it points to is replaced
    require_writable(path)
    require_free(target)
    clear_leftovers(target)
    temporary = temporary_name(target)
    try:
        yield temporary
        flushed(temporary)
        leave_record(target, temporary)
        os.replace(temporary, target)
        flushed(target.parent)
    except OSError as error:
        raise InputError(f"{path} must be writable, but writing it failed: {error}.") from error
    finally:
        with suppress(OSError):  # what went wrong before is said, not this
            temporary.unlink(missing_ok=True)


def write_state(path: Path, state: Mapping[str, Any], earlier: Path | None = None) -> None:
    """Write what a fit goes on with, whole or not at all; what was there before becomes `earlier`."""
    import torch

    content = io.BytesIO()  # torch says of a full disk what is no error of files
    torch.save(dict(state), content)
    with atomic_path(path) as temporary:
        temporary.write_bytes(content.getbuffer())
        if earlier is not None and path.is_file():
            os.replace(path, earlier)


def write_rows(path: str | Path, head: Sequence[str], rows: Iterable[Iterable[object]]) -> None:
    """Write a CSV file, whole or not at all."""
    with atomic_path(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file, lineterminator="\n").writerows([head, *rows])


def is_taken(path: str | Path) -> bool:
    """Whether something is at `path`: a file, a broken link, or a folder that is begun (`is_begun`)."""
    target = Path(path)
    return os.path.lexists(target) and (not target.is_dir() or is_begun(target))


def require_new(path: str | Path, way_out: str = "choose another name, or remove it first") -> None:
    """`InputError`, with the advice `way_out`, unless `path` is free (`is_taken`) and lies in an existing folder."""
    require(not is_taken(path), f"{path} must be new or empty, but it holds something already; {way_out}.")
    require_parent(path)


@contextmanager
def atomic_folder(path: str | Path) -> Iterator[Path]:
    """A temporary folder beside `path`, which must be new; it becomes `path` when the block ends well, and goes when it
    raises. Errors: `InputError` for a failure of the file system."""
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


def write_json(path: Path, values: dict[str, Any]) -> None:
    """Write `values` as JSON, whole or not at all."""
    text = json.dumps(values, indent=2, allow_nan=False)
    with atomic_path(path) as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")


def read_json(path: Path) -> dict[str, Any]:
    """A JSON table; `InputError` if the file is missing or damaged."""
    return read_table(path)
