"""`--resume RUN` alone: the scan and the options are those that the run was begun with."""

from __future__ import annotations

import os
import shlex
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from ..checks import InputError, as_written, require
from ..io.provenance import MADE, NAME, fingerprint, from_home, origin, records

AGAIN = "give the scan, the options and --out again, with --resume"
OF_ONE_CALL = ("--log", "--force", "--resume")
"""Options of the command that began a run which are not those of one that goes on."""
PERMISSION = "--allow-external"
"""What whoever goes on must say again: a run that came from elsewhere permits itself nothing."""


def resumed(arguments: Sequence[str]) -> list[str]:
    """Arguments with those of the run that `--resume RUN` names, where --out does not say it; else as they are.

    Errors: `InputError` for a folder that no such command began, and where its input is gone, or another.
    """
    name, *words = arguments or [""]
    at = next((n for n, word in enumerate(words) if word.partition("=")[0] == "--resume"), None)
    if at is None or any(word.partition("=")[0] == "--out" for word in words):
        return list(arguments)
    joined = words[at].partition("=")[2]
    value = joined or (words[at + 1] if at + 1 < len(words) else "")
    if not value or value.startswith("--"):
        return list(arguments)
    run, rest = Path(value), words[:at] + words[at + (1 if joined else 2) :]
    return [name, *_again(name, run), "--resume", *rest]


def is_made_by(path: Path, words: Sequence[str]) -> bool:
    """Whether the file or folder `path` says that the command with these `words` made it, as it is, from inputs which
    are what they were; of arguments that are too many files to be named one by one, this is taken to be so."""
    record = origin(path)
    with suppress(InputError), as_written(path):
        said, folder = shlex.split(record["command"])[1:], Path(from_home(record["folder"]))
        for one in record["inputs"]:
            if "files" not in one:
                _place(path if path.is_dir() else path.parent, folder, one)
        own = MADE not in record or record[MADE] == fingerprint(path)
        return own and [from_home(word) for word in _lasting(said)] == list(words)
    return False


def _again(name: str, run: Path) -> list[str]:
    """The words behind `name` that began `run`, with its own place, and with its inputs where they are now."""
    require(run.is_dir(), f"--resume must name a run folder, but {run} is none; check the path.")
    begun = records(run)
    require(
        bool(begun), f"--resume alone needs the command in {run / NAME}, but there is none, or it is damaged; {AGAIN}."
    )
    with as_written(run / NAME):
        _, command, *words = (word for word in shlex.split(begun[0]["command"]) if word != PERMISSION)
        folder = Path(from_home(begun[0]["folder"]))
        inputs = [(Path(one["path"]), dict(one)) for one in begun[0]["inputs"]]
    require(command == name, f"{run} was begun by holosplat {command}; go on with holosplat {command} --resume {run}.")
    return _moved(_lasting(words), {path: _place(run, folder, said) for path, said in inputs}, run)


def _lasting(words: Sequence[str]) -> list[str]:
    """The words without options that are of one call."""
    kept, skip = [], False
    for word in words:
        flag, is_joined, _ = word.partition("=")
        if not skip and flag not in OF_ONE_CALL:
            kept.append(word)
        skip = flag == "--log" and not is_joined
    return kept


def _moved(words: Sequence[str], places: Mapping[Path, Path], run: Path) -> list[str]:
    """The words with the places of inputs and of the run."""
    found, is_out = [], False
    for word in words:
        flag, is_joined, path = word.partition("=")
        if is_out or (flag == "--out" and is_joined):
            found.append(str(run) if is_out else f"--out={run}")
        elif Path(word) in places:
            found.append(str(places[Path(word)]))
        elif is_joined and Path(path) in places:
            found.append(f"{flag}={places[Path(path)]}")
        else:
            found.append(from_home(word))
        is_out = word == "--out" and not is_out
    return found


def _place(run: Path, folder: Path, said: Mapping[str, Any]) -> Path:
    """Where an input of `run` is: beside it as it was, or where it was; `InputError` where it is gone, or another."""
    beside = [Path(os.path.normpath(run / said["relative"]))] if "relative" in said else []
    ways = list(dict.fromkeys([*beside, folder / from_home(said["path"])]))
    there = [way for way in ways if way.exists()]
    looked = " and ".join(str(way) for way in ways)
    require(
        bool(there), f"{run} was begun with {said['path']}, but it is gone from {looked}; bring it back, or {AGAIN}."
    )
    hashed = {key: value for key, value in said.items() if key in ("bytes", "sha256", "sha256_of_ends")}
    for way in there:
        if fingerprint(way) == hashed:
            return way
    raise InputError(
        f"{run} was begun with another {said['path']} than {there[0]}, which has changed since; bring back what "
        "it was, or start anew into another --out."
    )
