"""Running the remaining tasks of a series in one process, or in several, which share the tasks by locks."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Container
from dataclasses import dataclass

from ..checks import require
from ..io.lock import TakenError
from .folder import FAILED, SeriesFolder, TaskState, cores
from .task import Told, nothing, run_task

POLL_SECONDS = 0.2
"""How often processes are asked whether they have ended."""
ENDING_SECONDS = 60.0
"""How long processes that were asked to end may take to save."""
PROGRAM = ("-c", "from holosplat.cli import main; main()")
"""What Python runs as the command line."""
THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
"""Where libraries look for their number of threads."""


@dataclass(frozen=True)
class Counts:
    """How many tasks are done, running elsewhere, failed and left."""

    done: int
    running: int
    failed: int
    left: int


def counted(states: list[TaskState]) -> Counts:
    """How many tasks are in each state."""
    names = [state.state for state in states]
    return Counts(*(names.count(name) for name in ("done", "running", "failed", "left")))


def states(folder: SeriesFolder) -> list[TaskState]:
    """How far every task is."""
    return [folder.state(window) for window in folder.plan().windows()]


def run_left(
    folder: SeriesFolder,
    retry: bool = False,
    on_row: Told = nothing,
    on_task: Callable[[TaskState], None] = lambda state: None,
    among: Container[int] | None = None,
) -> Counts:
    """Do all tasks that are left, one after another in this process; how far all of them are then.

    among: numbers of tasks, of which alone this is said and done (default: all). Errors: `InputError` where these are
    none of the series.

    Any number of processes may do so at once, also on several machines: a task is done by whoever locks it first, and
    those of others are passed over. Failed ones are left alone, unless `retry`. Ctrl-C is passed on.
    """

    def asked() -> list[TaskState]:
        every = states(folder)
        found = [state for state in every if among is None or state.number in among]
        require(bool(found), f"tasks are counted from 0 to {len(every) - 1}, but none of these is asked for.")
        return found

    for state in asked():
        if state.state not in ("left", *(["failed"] if retry else [])):
            continue
        if not retry and (folder.task(state.number) / FAILED).is_file():  # since
            continue
        try:
            on_task(run_task(folder, state.number, on_row))
        except TakenError:
            continue
    return counted(asked())


def run_processes(
    folder: SeriesFolder, jobs: int, retry: bool = False, on_poll: Callable[[], None] = lambda: None
) -> Counts:
    """Do all tasks that are left in `jobs` processes of this machine, which have cores / jobs threads each.

    Whatever happens to one of them, the others go on; how far all tasks are in the end. Ctrl-C is handed on to the
    processes, which save, and then passed on.
    """
    require(jobs >= 1, f"--jobs must be at least 1, but it is {jobs}.")
    allowed = folder.plan().reading.told.allow_external
    if retry:
        for state in states(folder):
            (folder.task(state.number) / FAILED).unlink(missing_ok=True)
    threads = str(max(1, cores() // jobs))
    environment = os.environ | dict.fromkeys(THREADS, threads)
    command = [sys.executable, *PROGRAM, "series", "run", str(folder.path), *["--allow-external"] * allowed]
    workers = [
        subprocess.Popen(command, env=environment, stdin=subprocess.DEVNULL, start_new_session=True)
        for _ in range(jobs)
    ]
    try:
        while any(worker.poll() is None for worker in workers):
            on_poll()
            time.sleep(POLL_SECONDS)
    finally:
        _end(workers)
    return counted(states(folder))


def _end(workers: list[subprocess.Popen[bytes]]) -> None:
    """Ask processes that still run to end, and make those that do not."""
    for worker in workers:
        if worker.poll() is None:
            worker.terminate()
    last = time.monotonic() + ENDING_SECONDS
    for worker in workers:
        try:
            worker.wait(max(0.0, last - time.monotonic()))
        except subprocess.TimeoutExpired:
            worker.kill()
            worker.wait()
