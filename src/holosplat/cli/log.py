"""`--log FILE` of every command: what it says on the terminal, line by line with the time, in a file that grows."""

from __future__ import annotations

import re
import shlex
import sys
import time
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any, TextIO

from ..checks import InputError, require
from ..io.folder import require_parent
from ..version import __version__
from .places import Place, require_apart

OWN = re.compile(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d ")
"""What each line of a log begins with."""
COLOUR = re.compile(r"\x1b\[[0-9;]*m")
REDRAWN = "\r"
"""What progress on a terminal begins its lines with; a log has lines of its own for it."""


class Log:
    """A log in the making."""

    def __init__(self, file: TextIO) -> None:
        self._file = file

    def say(self, line: str) -> None:
        """A line with the time; nothing of an empty one."""
        if line := COLOUR.sub("", line).rstrip():
            print(time.strftime("%Y-%m-%d %H:%M:%S"), line, file=self._file, flush=True)


class Copied:
    """A stream of the terminal whose whole lines go to a log, too."""

    def __init__(self, stream: TextIO, log: Log) -> None:
        self._stream, self.log, self._begun = stream, log, ""

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """As of the stream."""
        if REDRAWN not in text:
            *lines, self._begun = (self._begun + text).split("\n")
            for line in lines:
                self.log.say(line)
        return self._stream.write(text)


def log_of(stream: Any) -> Log | None:
    """The log to which the lines of a stream go, if there is one."""
    return stream.log if isinstance(stream, Copied) else None


@contextmanager
def logged(arguments: Sequence[str]) -> Iterator[None]:
    """Copy what the command with these `arguments` says to the file that --log names, behind what is there; nothing
    without that option.

    Errors: `InputError` for a file that is there and is no log.
    """
    path = _named(arguments)
    if path is None:
        yield
        return
    _require_log(path)
    try:
        file = path.open("a", encoding="utf-8", errors="backslashreplace")
    except OSError as error:
        raise InputError(f"--log must be a file to write, but {path} is not: {error}.") from None
    with file:
        log = Log(file)
        log.say(f"$ {shlex.join(['holosplat', *arguments])} (version {__version__})")
        out: Any = Copied(sys.stdout, log)
        err: Any = Copied(sys.stderr, log)
        try:
            with redirect_stdout(out), redirect_stderr(err):
                yield
        except SystemExit as end:
            log.say(f"ended with exit code {end.code or 0}")
            raise
        except BaseException:
            for line in traceback.format_exc().splitlines():
                log.say(line)
            raise
        log.say("ended with exit code 0")


def _named(arguments: Sequence[str]) -> Path | None:
    """The file behind --log; None where there is none."""
    for word, after in zip(arguments, [*arguments[1:], ""]):
        name, _, path = word.partition("=")
        if name == "--log" and (path or after):
            return Path(path or after)
    return None


def _require_log(path: Path) -> None:
    """`InputError` unless `path` is a log, empty, or new in an existing folder."""
    require_parent(path)
    require_apart([Place("--log", path, written=True, kept=True)])
    require(not path.is_dir(), f"--log must be a file, but {path} is a folder; add a file name.")
    if not path.exists():
        return
    good = path.is_file() and path.stat().st_size == 0
    if path.is_file() and not good:
        with path.open(encoding="utf-8", errors="replace") as file:
            good = OWN.match(file.read(80)) is not None
    require(good, f"--log must be a new file, or a log to go on with, but {path} is another file; name a new one.")
