"""Where commands write: no file that the same command reads, none twice, and none among the files of a run.

An option that names what is written has the type `Output`; all other paths are read.
"""

from __future__ import annotations

import inspect
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, is_dataclass
from functools import wraps
from pathlib import Path
from typing import Annotated, Any, ParamSpec, TypeVar, get_args, get_origin

from tyro.conf import Positional

from ..checks import require
from ..io.leftovers import LOCK
from ..ranges import flag, hints_of, with_checked_numbers
from ..workflows.manifest import MANIFEST

WRITTEN = "written"
Output = Annotated[Path, WRITTEN]
"""A path of a command that is written."""
POSITIONAL = get_args(Positional[Path])[1]
"""What marks an argument that has no flag."""
CONFIG = "config.json"
OF_A_RUN = (MANIFEST, LOCK, "object.h5", "gaussians.h5", "checkpoint.pt", "metrics.csv")
"""Beside config.json: what tells the folder of a run from others."""
TIME = re.compile(r"_t\d{4,}$")
"""What the names of files of single times end with."""
Given = ParamSpec("Given")
Returned = TypeVar("Returned")


@dataclass(frozen=True)
class Place:
    """A path that the option `flag` names."""

    flag: str
    path: Path
    written: bool

    def is_there(self) -> bool:
        """Whether something is there; False for texts that no path can be."""
        with suppress(OSError, ValueError):
            return self.path.exists()
        return False

    def is_same(self, other: Place) -> bool:
        """Whether both lead to one file or folder, by a link, too."""
        with suppress(OSError):
            return os.path.samefile(self.path, other.path)
        return os.path.realpath(self.path) == os.path.realpath(other.path)


def with_checked_arguments(function: Callable[Given, Returned]) -> Callable[Given, Returned]:
    """A command, or an act of one, that refuses numbers out of their ranges and outputs that would damage its input."""

    @wraps(function)
    def apart(*args: Given.args, **kwargs: Given.kwargs) -> Returned:
        bound = inspect.signature(function).bind(*args, **kwargs)
        bound.apply_defaults()
        require_apart(list(_places(bound.arguments, hints_of(function))))
        return function(*args, **kwargs)

    return with_checked_numbers(apart)


def require_apart(places: Sequence[Place]) -> None:
    """`InputError` that names the first output which is an input, another output, or within a run or an input."""
    read = [one for one in places if not one.written and one.is_there()]
    outputs = [one for one in places if one.written]
    for number, out in enumerate(outputs):
        for other in outputs[:number]:
            require(
                not (out.is_same(other) or _of_one_series(out.path, other.path)),
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
            _require_kept(out, source)


def is_run(folder: Path) -> bool:
    """Whether a folder is that of a run, finished or begun."""
    return (folder / CONFIG).is_file() and any((folder / name).exists() for name in OF_A_RUN)


def _require_kept(out: Place, source: Place) -> None:
    """`InputError` where writing `out` takes away `source`, or a file in it."""
    require(
        not out.is_same(source),
        f"{out.flag} must not be what the command reads, but {out.path} is; name another place.",
    )
    inside = out.path.is_file() and source.path.is_dir() and _is_in(out.path, source.path)
    require(
        not inside,
        f"{out.flag} must not replace a file of the folder {source.path}, which the command reads, but {out.path} is "
        "one; name another place.",
    )


def _is_in(path: Path, folder: Path) -> bool:
    return Path(os.path.realpath(folder)) in Path(os.path.realpath(path)).parents


def _of_one_series(one: Path, other: Path) -> bool:
    """Whether files of single times of the one may have the name of the other, or of its files."""
    names = [(path.parent.resolve(), TIME.sub("", path.stem), path.suffix) for path in (one, other)]
    return names[0] == names[1]


def _places(values: Mapping[str, Any], hints: Mapping[str, Any]) -> Iterator[Place]:
    """All paths among arguments, and texts that may name a file, alone or behind an =."""
    for name, value in values.items():
        for one in value if isinstance(value, tuple) else (value,):
            if is_dataclass(one) and not isinstance(one, type):
                yield from _places(vars(one), hints_of(type(one)))
            elif isinstance(one, Path):
                yield Place(_called(name, hints.get(name)), one, is_written(hints.get(name)))
            elif isinstance(one, str) and one:
                texts = {one, one.partition("=")[2], one.rpartition(":")[0]} - {""}
                files = (Place(flag(name), Path(text), False) for text in texts if "\0" not in text)
                yield from (file for file in files if file.is_there() and file.path.is_file())


def _called(name: str, hint: Any) -> str:
    """How messages call an argument: by its flag, or by its name in capitals where it stands alone."""
    return name.upper() if POSITIONAL in getattr(hint, "__metadata__", ()) else flag(name)


def is_written(hint: Any) -> bool:
    """Whether a type is, or has within it, that of outputs."""
    if get_origin(hint) is Annotated and WRITTEN in hint.__metadata__:
        return True
    return any(is_written(inner) for inner in get_args(hint))
