"""Commands in a process of their own that begins where this one stands: what they need is loaded already."""

from __future__ import annotations

import os
import resource
import signal
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from holosplat.cli import main
from holosplat.cli.entry import COMMANDS, command


@dataclass(frozen=True)
class Ended:
    """How a command ended. code: its exit code, None if a signal ended it; signal: which; seconds: that it ran."""

    code: int | None
    signal: int
    said: str
    seconds: float

    @property
    def verdict(self) -> str:
        """A traceback, a hang or a crash; empty for a command that worked, or ended with a sentence."""
        if "Traceback (most recent call last)" in self.said:
            return "traceback"
        if self.signal in (signal.SIGALRM, signal.SIGPROF):
            return "hang"
        return "crash" if self.code is None and self.signal != signal.SIGKILL else ""


def nothing() -> None:
    """What a command does first, unless it is told otherwise."""


EVENTS = ("open", "os.link", "os.mkdir", "os.remove", "os.rename", "os.rmdir", "os.truncate")
"""What Python says before it changes files (PEP 578)."""


def at_events(folder: Path, act: Callable[[int], None]) -> None:
    """From now on `act` with the number of each event, from 1 on, before this process changes files in `folder`."""
    count, within = 0, os.fspath(folder)

    def heard(event: str, arguments: tuple[Any, ...]) -> None:
        nonlocal count
        if event not in EVENTS or not isinstance(arguments[0], str | bytes | os.PathLike):
            return
        reads = event == "open" and not (isinstance(arguments[2], int) and arguments[2] & (os.O_WRONLY | os.O_RDWR))
        if not reads and within in os.fsdecode(arguments[0]):
            count += 1
            act(count)

    sys.addaudithook(heard)


WAITS = 10
"""Seconds that a command may wait for each of processor time: what else a machine does is no fault of it."""


def run(
    arguments: list[object],
    kill_after: float = 0.0,
    file_size: int = -1,
    limit: float = 60.0,
    first: Callable[[], None] = nothing,
) -> Ended:
    """A command, with everything it says.

    kill_after: seconds after which it is killed (0: never), as by a power cut of the process; file_size: bytes beyond
    which no file grows (-1: any), as on a full disk; limit: seconds of processor time after which it counts as hanging,
    or `WAITS` times as many of waiting; first: what its process does before the command begins.
    """

    def act() -> None:
        if file_size >= 0:
            signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
            resource.setrlimit(resource.RLIMIT_FSIZE, (file_size, resource.getrlimit(resource.RLIMIT_FSIZE)[1]))
        sys.argv = ["holosplat", *map(str, arguments)]
        first()
        main()

    return attempted(act, kill_after, limit)


def attempted(act: Callable[[], None], kill_after: float = 0.0, limit: float = 60.0) -> Ended:
    """The same of any `act`."""
    reading, writing = os.pipe()
    begun = time.perf_counter()
    child = os.fork()
    if child == 0:
        os.close(reading)
        _become(act, writing, limit)
    os.close(writing)
    if kill_after:
        _killed(child, kill_after)
    with os.fdopen(reading, "rb") as pipe:
        said = pipe.read().decode(errors="replace")
    status = os.waitpid(child, 0)[1]
    code = os.waitstatus_to_exitcode(status)
    return Ended(code if code >= 0 else None, max(-code, 0), said, time.perf_counter() - begun)


def _killed(child: int, after: float) -> None:
    """Kill the child then, unless it has ended; the parent waits no longer than it lives."""
    ends = time.perf_counter() + after
    while time.perf_counter() < ends:
        if os.waitid(os.P_PID, child, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None:
            return
        time.sleep(0.002)
    os.kill(child, signal.SIGKILL)


def _become(act: Callable[[], None], writing: int, limit: float) -> None:
    """Do it in this process, which ends with it."""
    code = 1
    try:
        os.dup2(writing, 1)
        os.dup2(writing, 2)
        sys.stdout, sys.stderr = os.fdopen(1, "w"), os.fdopen(2, "w")
        for alarm, timer, seconds in (
            (signal.SIGPROF, signal.ITIMER_PROF, limit),
            (signal.SIGALRM, signal.ITIMER_REAL, WAITS * limit),
        ):
            signal.signal(alarm, signal.SIG_DFL)
            signal.setitimer(timer, seconds)
        code = _code(act)
        sys.stdout.flush()
        sys.stderr.flush()
    finally:
        os._exit(code)


def _code(act: Callable[[], None]) -> int:
    import traceback

    try:
        act()
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else 0 if end.code is None else 1
    except BaseException:
        traceback.print_exc()
        return 1
    return 0


NEEDED = (
    "beamline.grow beamline.record beamline.simulate io.formats io.objects io.volumes "
    "io.nxtomo methods.presets report.run specimens.red_cells workflows.correct workflows.evaluate workflows.join "
    "workflows.reconstruct workflows.track report.content report.moving_figures align.views"
)
OF_BENCHMARK = ("run", "methods", "pages")


def loaded() -> None:
    """Import all that commands import, so that they begin at once; figures stay blank."""
    for name in COMMANDS:
        command(name)
    for name in NEEDED.split():
        import_module(f"holosplat.{name}")
    for name in OF_BENCHMARK:
        import_module(f"holosplat_bench.suite.{name}")
    import_module("torch._dynamo")
    import_module("matplotlib.figure").Figure.savefig = _blank


def _blank(figure: Any, target: Any, *arguments: Any, **options: Any) -> None:
    """In place of a figure's picture, whose drawing takes most of the time of a short run."""
    Path(target).write_bytes(b"") if isinstance(target, str | Path) else target.write(b"")


def size_of(path: Path) -> int:
    """Bytes of the largest file at `path`."""
    files = [path] if path.is_file() else [file for file in path.rglob("*") if file.is_file()]
    return max((file.stat().st_size for file in files), default=0)
