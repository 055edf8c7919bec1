"""What commands say while they work: notes, progress, their log file; and the signals that end them."""

from __future__ import annotations

import logging
import re
import shlex
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from functools import partial
from pathlib import Path
from types import FrameType, MappingProxyType, TracebackType
from typing import TYPE_CHECKING, Any, TextIO

from ..checks import InputError, require
from ..io.atomic import require_parent
from ..progress import Advance
from ..version import __version__
from .places import Place, require_apart

if TYPE_CHECKING:
    from tqdm import tqdm

TOLD = 0.03
"""Share of what was left at first that must be done before the time left is said."""
STEP, SHORTEST_S, LONGEST_S = 0.05, 2.0, 60.0
"""Of lines in place of a bar: the share from one to the next, and their shortest and longest pause [s]."""


class _Notes(logging.Handler):
    """Prints what `checks.note` and `checks.warn` say on standard error, above a progress bar, and each of it once."""

    def __init__(self) -> None:
        super().__init__()
        self._known = set[str]()

    def emit(self, record: logging.LogRecord) -> None:
        """See `logging.Handler.emit`."""
        text = ("warning: " if record.levelno >= logging.WARNING else "") + record.getMessage()
        if text in self._known:
            return
        self._known.add(text)
        tqdm = sys.modules.get("tqdm")
        if tqdm is None:
            print(text, file=sys.stderr)
        else:
            tqdm.tqdm.write(text, file=sys.stderr)


def say_notes() -> None:
    """From now on notes and warnings on the input are printed."""
    logger = logging.getLogger("holosplat")
    logger.setLevel(logging.INFO)
    logger.handlers = [_Notes()]
    logging.getLogger("tifffile").setLevel(logging.CRITICAL)  # what it says of damage, a sentence of ours says


class ProgressBar:
    """Progress on standard error: a bar on a terminal, else (and in a log) a line now and then. clock: the time [s]."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._bar: tqdm | None = None
        self._stage, self._lines, self._clock = "", None, clock

    _lines: _Lines | None

    def __enter__(self) -> ProgressBar:
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._close()

    def of(self, stage: str) -> Advance:
        """What shows how far the stage is."""
        return partial(self.show, stage)

    def show(self, stage: str, fraction: float, record: Mapping[str, float] = MappingProxyType({})) -> None:
        """Show that a stage is done to `fraction`, with loss, count and steps a second of a fit's `record`. The time
        left goes by the mean speed since the stage was first shown."""
        fraction = max(0.0, min(1.0, fraction))
        if stage != self._stage:
            self._close()
            self._begin(stage, fraction)
        said = ""
        if record:
            speed = record["step"] / record["seconds"] if record["seconds"] > 0 else 0.0
            size = f"{record['count']:.0f} Gaussians, " if "count" in record else ""
            said = f"loss {record['loss']:.3e}, {size}{speed:.1f} steps/s"
        if self._lines is not None:
            self._lines.show(fraction, said)
        if self._bar is not None:
            if said:
                self._bar.set_postfix_str(said, refresh=False)
            self._bar.bar_format = _WITH_LEFT if _tells(self._bar.initial, fraction) else _FORMAT
            self._bar.update(max(0.0, fraction - self._bar.n))

    def _begin(self, stage: str, fraction: float) -> None:
        """A bar on a terminal, and lines in the log, if there is one; elsewhere lines on standard error."""
        self._stage, log = stage, sys.stderr.log if isinstance(sys.stderr, Copied) else None
        if not sys.stderr.isatty():
            self._lines = _Lines(stage, fraction, self._clock, lambda line: print(line, file=sys.stderr, flush=True))
            return
        from tqdm import tqdm

        how = {"bar_format": _FORMAT, "file": sys.stderr, "mininterval": 0.2, "smoothing": 0}
        self._bar = tqdm(total=1.0, initial=fraction, desc=stage, **how)
        self._lines = None if log is None else _Lines(stage, fraction, self._clock, log.say)

    def _close(self) -> None:
        whole = sys.exc_info()[0] is None
        if self._bar is not None:
            self._bar.bar_format = _FORMAT
            self._bar.update(max(0.0, 1.0 - self._bar.n) if whole else 0.0)
            self._bar.close()
        if self._lines is not None and whole:
            self._lines.show(1.0, "")
        self._bar, self._lines, self._stage = None, None, ""


class _Lines:
    """Progress of one stage as lines: one each twentieth, not within seconds of another, but one every minute."""

    def __init__(self, stage: str, begun: float, clock: Callable[[], float], say: Callable[[str], None]) -> None:
        self._stage, self._begun, self._clock, self._say = stage, begun, clock, say
        self._began = clock()
        self._shown, self._at = -1.0, self._began

    def show(self, fraction: float, said: str) -> None:
        """A line, if one is due."""
        now, step = self._clock(), fraction - self._shown
        pause = now - self._at
        is_step = step >= STEP or (fraction == 1 and step > 0)
        if self._shown >= 0 and pause < (SHORTEST_S if is_step else LONGEST_S):
            return
        words = [f"{self._stage}: {fraction:.0%}", _spent(now - self._began)]
        if _tells(self._begun, fraction):
            words.append(f"{_spent((now - self._began) * (1 - fraction) / (fraction - self._begun))} left")
        self._say(", ".join([*words, said] if said else words) if self._shown >= 0 else f"{self._stage} …")
        self._shown, self._at = fraction, now


def _tells(begun: float, fraction: float) -> bool:
    """Whether enough is done, and not all, to say how long the rest takes."""
    return begun + TOLD * (1 - begun) <= fraction < 1 and fraction > begun


def _spent(seconds: float) -> str:
    """A time as one reads it."""
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{seconds:02d}" if hours else f"{minutes}:{seconds:02d}"


_FORMAT = "{desc:28s} {percentage:3.0f}%|{bar:24}| {elapsed}{postfix}"
_WITH_LEFT = _FORMAT.replace("{elapsed}", "{elapsed}, {remaining} left")


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


@contextmanager
def logged(arguments: Sequence[str]) -> Iterator[None]:
    """Add what the command with these `arguments` says to the file that --log names, if it does; `InputError` for a
    file that is no log."""
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


ASKING = (signal.SIGTERM, signal.SIGHUP)
"""A cluster's warning before it kills, and a terminal that is gone."""


def end_as_on_interrupt() -> None:
    """From now on these signals do what Ctrl-C does, also where that is switched off, as in jobs of a shell's
    background; those that are ignored, as under nohup, stay ignored. Only a main thread can say so."""
    if threading.current_thread() is not threading.main_thread():
        return
    for number in ASKING:
        if signal.getsignal(number) is signal.SIG_DFL:
            signal.signal(number, _interrupt)


def _interrupt(number: int, frame: FrameType | None) -> None:
    action = signal.getsignal(signal.SIGINT)
    if not callable(action) or action is signal.SIG_IGN or action is signal.SIG_DFL:
        raise KeyboardInterrupt
    action(number, frame)
