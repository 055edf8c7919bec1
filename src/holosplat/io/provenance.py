"""Where files come from: the command line, the version and the hashes of what was read, with every file of a command.

HDF5 files have it as the attribute `provenance` of their root, folders in provenance.json, which has a record for each
command that wrote there, other files beside them in NAME.provenance.json. It is there before the file is, so that
no file is without it after a crash. Paths in one's home begin with ~.
"""

from __future__ import annotations

import hashlib
import json
import os
import shlex
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import lru_cache
from itertools import groupby
from pathlib import Path
from typing import Any

from ..checks import require
from ..tables import read_table, table_in
from ..version import __version__, source_commit
from .lock import LOCK, clear_leftovers, files_in, flushed, is_begun, is_left, temporary_name
from .lock import RECORD as NAME

ATTRIBUTE = "provenance"
RECORDS, MADE = "records", "made"
HDF5 = b"\x89HDF\r\n\x1a\n"
"""What HDF5 files begin with."""
GARBLED = (OSError, ValueError, LookupError, TypeError, RuntimeError)
"""What reading a record ends in that is damaged, or none."""
MOST_BYTES = 1 << 32
"""What is read of one input for its hash, at most: some seconds."""
MOST_NAMED = 8
"""Files of one argument that are named one by one."""
MOST_TEXT = 16000
"""Characters of a command line in an attribute of HDF5, which takes 64 kB."""


@dataclass
class Command:
    """A command that is being carried out: its words as typed, its inputs as pairs of argument and path, its outputs,
    whether it may replace files, and whether it goes on with what another one began."""

    words: Sequence[str]
    inputs: Sequence[tuple[str, Path]]
    outputs: Sequence[Path]
    force: bool = False
    goes_on: bool = False
    folder: Path = field(default_factory=Path.cwd)
    done: set[Path] = field(default_factory=set)
    """Files that this command has written, and folders that have its record."""
    decided: dict[str, Any] = field(default_factory=dict)
    """What it decided before it wrote anything, by name."""

    _hashed: dict[tuple[Path, ...], dict[str, Any]] = field(default_factory=dict)

    def record(self, near: Path) -> dict[str, Any]:
        """What is said of this command in the folder `near`, from which inputs are named, too."""
        inputs, home = [], Path.home()
        for _, group in groupby(self.inputs, key=lambda one: one[0]):
            paths = [path for _, path in group if Path(os.path.realpath(path)) not in (near, *near.parents)]
            for few in [[path] for path in paths] if len(paths) <= MOST_NAMED else [paths]:
                if (key := tuple(few)) not in self._hashed:  # as they were when the first file was written
                    self._hashed[key] = ({"files": len(few)} if len(few) > 1 else {}) | fingerprint(*few)
                place = Path(os.path.abspath(self.folder / few[0]))
                names_home = home in place.parents and home not in (near, *near.parents)  # as the way from `near` would
                relative = {} if names_home else {"relative": os.path.relpath(place, near)}
                inputs.append({"path": home_safe(str(few[0])), **relative, **self._hashed[key]})
        words = " ".join(map(_quoted, ["holosplat", *self.words]))
        said = {"command": words, "folder": home_safe(str(self.folder)), "inputs": inputs}
        return {**_program(), **said, **({"decided": self.decided} if self.decided else {})}


_now: list[Command] = []
"""The command of this process, if there is one."""


@contextmanager
def carried_out(command: Command) -> Iterator[None]:
    """In the block, files that are written say that they are of `command`."""
    take_up(command)
    try:
        yield
    finally:
        _now.clear()


def take_up(command: Command | None) -> None:
    """From now on this process is one of `command`."""
    _now[:] = [] if command is None else [command]


def command_now() -> Command | None:
    """The command of this process; None outside of the command line."""
    return _now[0] if _now else None


def attribute(path: Path) -> str:
    """What the HDF5 file `path` says of itself: what made it, and by which command, if there is one."""
    command = command_now()
    record = command.record(path.parent) if command else _program()
    text = record.get("command", "")
    if len(text) > MOST_TEXT:
        record["command"] = f"{text[: MOST_TEXT // 2]} … {text[-MOST_TEXT // 2 :]}"
    return json.dumps(record)


def beside(path: Path) -> Path:
    """The file that says where `path` comes from, of a format that cannot say so itself."""
    return path.with_name(f"{path.name}.{NAME}")


def require_free(path: Path) -> None:
    """`InputError` where a command would replace the file `path`, which stands by itself and is not its own, without
    --force, or another program's file `beside` it."""
    command = command_now()
    if command is None or path in command.done or _folder_of(path, command) is not None:
        return
    require(
        command.force or not path.exists(),
        f"{path} must be new, but it is there already; choose another name, or add --force to replace it.",
    )
    require(
        not os.path.lexists(beside(path)) or "program" in origin(path),
        f"{beside(path)} must be new, or say where {path.name} comes from, but it is another file; choose another name "
        f"than {path.name}.",
    )


def leave_record(path: Path, made: Path) -> None:
    """Say where a file or folder comes from, which a command has `made` and which becomes `path`: beside it, with what
    is in it, in the folder itself, or in the one to which it belongs."""
    command = command_now()
    if command is None or any(map(is_left, path.parents)):  # a folder in the making
        return
    command.done.add(path)
    folder = _folder_of(path, command)
    if folder is None and made.is_dir():
        command.done.add(path / NAME)
        _write(made / NAME, {RECORDS: [command.record(path)]})
    elif folder is None and not is_hdf5(made):
        _write(beside(path), command.record(path.parent) | {MADE: fingerprint(made)})
    elif folder is not None and folder / NAME not in command.done:
        command.done.add(folder / NAME)
        before = records(folder) if command.goes_on or is_begun(folder) else []
        _write(folder / NAME, {RECORDS: [*before, command.record(folder)]})


def records(folder: Path) -> list[dict[str, Any]]:
    """The record of each command that wrote to a folder, the first one first; nothing where there is none of ours."""
    with suppress(*GARBLED):
        return [dict(each) for each in read_table(folder / NAME)[RECORDS]]
    return []


def origin(path: Path) -> dict[str, Any]:
    """The record of the command that made a file or folder, or began it; empty where none says so."""
    if path.is_dir():
        return next(iter(records(path)), {})
    with suppress(*GARBLED):
        if not is_hdf5(path):
            return read_table(beside(path))
        from .hdf5_guard import opened_for_reading

        with opened_for_reading(path) as file:
            return table_in(str(file.attrs[ATTRIBUTE]))
    return {}


def fingerprint(*paths: Path) -> dict[str, Any]:
    """Bytes and SHA-256 of a file, or of the hashes of all files of folders in order; beyond `MOST_BYTES` of the
    beginnings and ends of files (`sha256_of_ends`)."""
    try:
        files = [file for path in paths for file in ([path] if path.is_file() else files_in(path))]
        states = [file.stat() for file in files]
        size = sum(state.st_size for state in states)
        share = None if size <= MOST_BYTES else MOST_BYTES // len(files)
        hashes = [_sha256(file, state.st_size, state.st_mtime_ns, share) for file, state in zip(files, states)]
    except OSError:
        return {"sha256": None}
    alone = len(paths) == 1 and paths[0].is_file()
    digest = hashes[0] if alone else hashlib.sha256("".join(hashes).encode()).hexdigest()
    return {"bytes": size, "sha256" if share is None else "sha256_of_ends": digest}


def sha256(path: Path) -> str:
    """The SHA-256 of a file's bytes, as hexadecimal digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


@lru_cache(maxsize=1 << 16)
def _sha256(path: Path, size: int, changed: int, share: int | None) -> str:
    """The SHA-256 of a file of this size, changed then; of `share` bytes of it, half of them at its end."""
    if share is None or size <= share:
        return sha256(path)
    with path.open("rb") as file:
        digest = hashlib.sha256(file.read(share // 2))
        file.seek(size - share // 2)
        digest.update(file.read(share // 2))
    return digest.hexdigest()


def home_safe(text: str) -> str:
    """A path, or an option with one, that says ~ for one's home."""
    home = str(Path.home())
    at = text.find(home)
    whole = at >= 0 and text[at + len(home) :][:1] in ("", "/") and text[:at][-1:] in ("", "=")
    return f"{text[:at]}~{text[at + len(home) :]}" if whole and len(home) > 1 else text


def from_home(text: str) -> str:
    """What `home_safe` made safe, on this machine."""
    before, is_option, path = text.rpartition("=")
    return before + is_option + str(Path.home()) + path[1:] if path == "~" or path.startswith("~/") else text


def _program() -> dict[str, Any]:
    commit = source_commit()
    made = {"program": "holosplat", "version": __version__, **({"commit": commit} if commit else {})}
    return made | {"date": datetime.now(UTC).isoformat(timespec="seconds")}


def _quoted(word: str) -> str:
    """A word of a command line as a shell takes it; ~ stays what it is for shells."""
    safe = home_safe(word)
    return f"~/{shlex.quote(safe[2:])}" if safe.startswith("~/") and safe != word else shlex.quote(safe)


def _folder_of(path: Path, command: Command) -> Path | None:
    """The folder, made by this command or an earlier one, to which a file belongs; None for what stands by itself."""
    outputs = [Path(os.path.realpath(out)) for out in command.outputs]
    for folder in path.parents:
        if folder in outputs or (folder / LOCK).exists():
            return folder
        if any(out.parent == folder for out in outputs):
            return None
        if records(folder):
            return folder
    return None


def is_hdf5(path: Path) -> bool:
    """Whether `path` is a file in HDF5. Errors: `OSError` for what cannot be read."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(len(HDF5)) == HDF5


def _write(path: Path, values: dict[str, Any]) -> None:
    clear_leftovers(path)
    temporary = temporary_name(path)
    temporary.write_text(json.dumps(values, indent=2) + "\n", encoding="utf-8")
    flushed(temporary)
    os.replace(temporary, path)
