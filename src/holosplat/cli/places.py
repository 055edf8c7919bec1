"""Where commands write: no file that the same command reads, none twice, none among the files of a run, and
none that is there already, unless --force says so.

An option that names what is written has the type `Output`, or `Kept`; all other paths are read.
"""

from __future__ import annotations

import inspect
import os
import re
import shutil
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, is_dataclass, replace
from functools import wraps
from pathlib import Path
from typing import Annotated, Any, ParamSpec, TypeVar, get_args, get_origin

from tyro.conf import Positional, arg

from ..checks import InputError, require
from ..io.atomic import is_taken, read_json, require_new, require_parent
from ..io.lock import LOCK, require_unwritten
from ..io.provenance import NAME, Command, beside, carried_out, records
from ..ranges import flag, hints_of, with_checked_numbers
from ..workflows.provenance import MANIFEST
from .sentence import say_that_libraries_load

WRITTEN = "written"
Output = Annotated[Path, WRITTEN]
"""A path of a command that is written, and must be new."""
GOES_ON = "goes on"
Kept = Annotated[Path, WRITTEN, GOES_ON]
"""A folder that the same command goes on with."""
POSITIONAL = get_args(Positional[Path])[1]
"""What marks an argument that has no flag."""
CONFIG = "config.json"
OF_A_RUN = (MANIFEST, LOCK, "object.h5", "gaussians.h5", "checkpoint.pt", "metrics.csv")
"""Beside config.json: what tells the folder of a run from others."""
SOURCE = "source.json"
"""Where a run says which scan it is of."""
PAIRED = (".nrrd", ".mrc")
"""Suffixes of files of δ, beside which β has one of its own (`io.plain_values.both`)."""
TIME = re.compile(r"_t\d{4,}(?=\.|$)")
"""What the names of files of single times have before their suffixes."""
REPLACED = ".replaced"
"""What the name of a folder ends with while another one takes its place."""
Force = Annotated[bool, arg(help="Replace what is there already.")]
LogFile = Annotated[Path | None, arg(help="Write what the terminal shows, with the time of each line, to a file, too.")]
Given = ParamSpec("Given")
Returned = TypeVar("Returned")


@dataclass(frozen=True)
class Place:
    """A path that the option `flag` names."""

    flag: str
    path: Path
    written: bool
    kept: bool = False

    def is_there(self) -> bool:
        """Whether something is there; False for texts that no path can be."""
        with suppress(OSError, ValueError):
            return self.path.exists()
        return False

    def companions(self) -> Iterator[Place]:
        """What goes with it: the file of β, the record of an output's origin, and the scan of a run that is read."""
        if self.path.suffix.lower() in PAIRED:
            from ..io.plain_values import both  # needs more than options do

            yield replace(self, path=both(self.path)[1])
        if self.written:
            yield replace(self, path=beside(self.path))
        else:
            with suppress(InputError, OSError):
                yield replace(self, path=Path(str(read_json(self.path / SOURCE).get("scan"))))

    def is_same(self, other: Place) -> bool:
        """Whether both lead to one file or folder, by a link, too."""
        with suppress(OSError):
            return os.path.samefile(self.path, other.path)
        return os.path.realpath(self.path) == os.path.realpath(other.path)


def with_checked_arguments(function: Callable[Given, Returned]) -> Callable[..., Returned]:
    """A command, or an act of one, with the options --log and, where it writes, --force. It refuses numbers out of
    range and outputs that would damage its input or replace what is there, and records where outputs come from."""
    signature, hints = inspect.signature(function), hints_of(function)
    writes = any(map(is_written, _leaves(hints)))

    @wraps(function)
    def apart(*args: Any, log: Path | None = None, force: bool = False, **kwargs: Any) -> Returned:
        bound = signature.bind(*args, **kwargs)
        bound.apply_defaults()
        places = list(_places(bound.arguments, hints))
        require_apart([*places, *([Place("--log", log, True, True)] if log else [])])
        resume = bound.arguments.get("resume")
        require(not (force and resume), "--force begins anew, and --resume goes on; give one of them.")
        outputs = [one for one in places if one.written]
        for out in outputs:
            _require_free(out, places, force, resume)
        read = [(one.flag, one.path) for one in places if not one.written and one.is_there()]
        command = Command(sys.argv[1:], read, [out.path for out in outputs], force, bool(resume))
        if writes and all(one.written or one.is_there() for one in places):
            say_that_libraries_load()
        with carried_out(command), _set_aside(command.outputs if force else []):
            return function(*args, **kwargs)

    added = {"log": LogFile} | ({"force": Force} if writes else {})
    keyword, usual = inspect.Parameter.KEYWORD_ONLY, {"log": None, "force": False}
    options = [inspect.Parameter(name, keyword, default=usual[name], annotation=kind) for name, kind in added.items()]
    setattr(apart, "__signature__", signature.replace(parameters=[*signature.parameters.values(), *options]))  # noqa: B010
    checked = with_checked_numbers(apart)
    checked.__annotations__ = hints | added
    del checked.__wrapped__  # the parser looks for types there, beyond the options that are added
    setattr(checked, "__signature__", inspect.signature(apart))  # noqa: B010
    return checked


def places_of(function: Callable[..., Any], values: Mapping[str, Any]) -> list[Place]:
    """The places that arguments of a checked command name; `values` are its arguments by name."""
    return list(_places(values, hints_of(function)))


def require_apart(places: Sequence[Place]) -> None:
    """`InputError` for an output that is an input, another output, or within a run or an input, with their
    companions."""
    for place in places:
        require(
            not place.written or bool(place.path.name),
            f"{place.flag} must name what is made, but {place.path} is a folder without a name; name a new one in it.",
        )
    every = [one for place in places for one in (place, *place.companions())]
    read = [one for one in every if not one.written and one.is_there()]
    outputs = [one for one in every if one.written]
    for number, out in enumerate(outputs):
        for other in outputs[:number]:
            alike = [(one.path.parent.resolve(), TIME.sub("", one.path.name)) for one in (out, other)]
            require(
                not out.is_same(other) and alike[0] != alike[1],  # nor files of single times
                f"{out.flag} and {other.flag} must be different places, but they are {out.path} and {other.path}; name "
                "another one.",
            )
        for folder in Path(os.path.realpath(out.path)).parents:
            require(
                not is_run(folder),
                f"{out.flag} must be outside of run folders, whose files belong together, but {out.path} is in the run "
                f"{folder}; name another place.",
            )
        for source in read:
            require(
                not out.is_same(source),
                f"{out.flag} must not be what the command reads, but {out.path} is; name another place.",
            )
            inside = out.path.is_file() and source.path.is_dir() and _is_in(out.path, source.path)
            require(
                not inside,
                f"{out.flag} must not replace a file of the folder {source.path}, which the command reads, but "
                f"{out.path} is one; name another place.",
            )


def _require_free(out: Place, places: Sequence[Place], force: bool, resume: bool | None) -> None:
    """`InputError` where something is at `out` that may not be replaced, or gone on with."""
    if resume or (out.kept and not force):
        return
    if not force:
        way_out = f"choose another {out.flag}, or add --force to replace it"
        for path in (out.path, *of_times(out.path)):
            require_new(path, way_out if resume is None else f"{way_out}, or --resume to go on with it")
        return
    require_parent(out.path)
    for folder in _folders((out.path,)):
        _require_replaceable(folder, out.flag, places)


def _folders(paths: Sequence[Path]) -> list[Path]:
    """The folders that hold something among `paths`, and among what is there of single times of these."""
    return [one for path in paths for one in (path, *of_times(path)) if one.is_dir() and is_taken(one)]


def _require_replaceable(folder: Path, option: str, places: Sequence[Place]) -> None:
    """`InputError` for a folder that --force must not replace."""
    require(
        is_run(folder) or bool(records(folder)),
        f"--force replaces folders that holosplat made, but {folder} has no {NAME} of it; remove it yourself, or "
        f"choose another {option}.",
    )
    for lock in folder.rglob(LOCK):
        require_unwritten(lock.parent)
    for source in places:
        require(
            source.written or not source.is_there() or not _is_in(source.path, folder),
            f"--force must not remove what the command reads, but {source.path} is in {folder}; choose another "
            f"{option}.",
        )
    aside = _aside(folder)
    require(
        not os.path.lexists(aside), f"{aside} is what an earlier --force was to replace; rename it back, or remove it."
    )


def _aside(folder: Path) -> Path:
    return folder.with_name(folder.name + REPLACED)


@contextmanager
def _set_aside(paths: Sequence[Path]) -> Iterator[None]:
    """In the block, folders among `paths` have another name; then they go, or come back where nothing replaced them."""
    folders = [path.absolute() for path in _folders(paths)]
    try:
        for folder in folders:
            os.rename(folder, _aside(folder))
        yield
    finally:
        for folder in folders:
            if is_taken(folder):
                if _aside(folder).is_symlink():
                    _aside(folder).unlink()
                shutil.rmtree(_aside(folder), ignore_errors=True)
            elif _aside(folder).is_dir():
                shutil.rmtree(folder, ignore_errors=True)
                os.rename(_aside(folder), folder)


def of_times(path: Path) -> list[Path]:
    """What is there of files of single times, which have the name `path` but for their time."""
    with suppress(OSError):
        return sorted(one for one in path.parent.iterdir() if TIME.sub("", one.name, count=1) == path.name != one.name)
    return []


def is_run(folder: Path) -> bool:
    """Whether a folder is that of a run, finished or begun."""
    return (folder / CONFIG).is_file() and any((folder / name).exists() for name in OF_A_RUN)


def _is_in(path: Path, folder: Path) -> bool:
    return Path(os.path.realpath(folder)) in Path(os.path.realpath(path)).parents


def _places(values: Mapping[str, Any], hints: Mapping[str, Any]) -> Iterator[Place]:
    """All paths among arguments, and texts that may name a file, alone or behind an =."""
    for name, value in values.items():
        for one in value if isinstance(value, tuple) else (value,):
            if is_dataclass(one) and not isinstance(one, type):
                yield from _places(vars(one), hints_of(type(one)))
            elif isinstance(one, Path):
                hint = hints.get(name)
                called = name.upper() if POSITIONAL in getattr(hint, "__metadata__", ()) else flag(name)
                yield Place(called, one, is_written(hint), is_written(hint, GOES_ON))
            elif isinstance(one, str) and one:
                texts = {one, one.partition("=")[2], one.rpartition(":")[0]} - {""}
                files = (Place(flag(name), Path(text), False) for text in texts if "\0" not in text)
                yield from (file for file in files if file.is_there() and file.path.is_file())


def is_written(hint: Any, mark: str = WRITTEN) -> bool:
    """Whether a type is, or has within it, that of outputs."""
    if get_origin(hint) is Annotated and mark in hint.__metadata__:
        return True
    return any(is_written(inner, mark) for inner in get_args(hint))


def _leaves(hints: Mapping[str, Any]) -> Iterator[Any]:
    """Types of arguments, those of the fields of dataclasses in their place."""
    for hint in hints.values():
        kind = next((one for one in (hint, *get_args(hint)) if isinstance(one, type) and is_dataclass(one)), None)
        if kind is None:
            yield hint
        else:
            yield from _leaves(hints_of(kind))
