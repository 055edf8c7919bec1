"""Running the remaining tasks of a series in one process, or in several, which share the tasks by locks."""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
import time
from collections.abc import Callable, Container, Sequence
from dataclasses import dataclass
from pathlib import Path

from ..checks import InputError, MissingError, require
from ..io.atomic import atomic_path
from ..io.lock import TakenError
from .folder import FAILED, SeriesFolder, TaskState, cores
from .plan import Slurm
from .task import OnRow, nothing, run_task

MOST_SECONDS = 60
"""How long sbatch may take [s]."""


def ranges_of(numbers: Sequence[int]) -> str:
    """Rising whole numbers as Slurm lists them: 0, 1, 2, 5 → 0-2,5."""
    parts = list[list[int]]()
    for number in numbers:
        if parts and number == parts[-1][1] + 1:
            parts[-1][1] = number
        else:
            parts.append([number, number])
    return ",".join(str(low) if low == high else f"{low}-{high}" for low, high in parts)


def script_of(folder: SeriesFolder, numbers: Sequence[int], options: Slurm, retry: bool = False) -> str:
    """The script that runs the tasks `numbers`, a block of them in each job of an array.

    A job's number is that of its first task; of a block, tasks that are done are passed over, and failed ones, too,
    unless `retry`.
    """
    path = str(folder.path.resolve())
    require(path.isprintable() and '"' not in path, f"{path!r} cannot stand in a Slurm script; use a plainer path.")
    firsts = sorted({number - number % options.block for number in numbers})
    array = ranges_of(firsts) + (f"%{options.limit}" if options.limit else "")
    asked = {
        "job-name": "holosplat",
        "array": array,
        "partition": options.partition,
        "account": options.account,
        "time": options.time,
        "mem": options.memory,
        "gres": options.gres,
        "cpus-per-task": str(options.cpus),
        "signal": "B:TERM@60",  # a minute to save before the limit ends the job
        "output": f'"{path}/{folder.logs.name}/%A_%a.out"',
    }
    lines = [f"#SBATCH --{name}={value}" for name, value in asked.items() if value]
    command = shlex.join([sys.executable, *PROGRAM, "series", "run", path])
    allowed = " --allow-external" * folder.plan().reading.told.allow_external
    block = (f" --block {options.block}" + " --retry" * retry) if options.block > 1 else ""
    return "\n".join(
        [
            "#!/bin/bash",
            *lines,
            "set -euo pipefail",
            'export OMP_NUM_THREADS="${SLURM_CPUS_PER_TASK:-1}"',
            f'exec {command} "$SLURM_ARRAY_TASK_ID"{block}{allowed}',
            "",
        ]
    )


def write_script(folder: SeriesFolder, options: Slurm, retry: bool = False) -> tuple[int, str]:
    """Write slurm.sh for what is left (and, with `retry`, for what failed); the number of tasks, and their list.

    Errors: `InputError` where nothing is left.
    """
    numbers = [state.number for state in remaining(states(folder), retry)]
    require(bool(numbers), f"{folder.path} has no task that is left; holosplat series status says how far it is.")
    text = script_of(folder, numbers, options, retry)
    folder.logs.mkdir(exist_ok=True)
    with atomic_path(folder.script) as temporary:
        temporary.write_text(text, encoding="utf-8")
        temporary.chmod(0o755)
    return len(numbers), ranges_of(numbers)


def submit(folder: SeriesFolder) -> str:
    """Submit slurm.sh; the number of the job. Errors: `InputError` without sbatch, or with what it says."""
    try:
        done = subprocess.run(
            ["sbatch", "--parsable", str(folder.script.resolve())],
            capture_output=True,
            text=True,
            errors="replace",
            check=False,
            timeout=MOST_SECONDS,
        )
    except FileNotFoundError:
        raise InputError("--submit needs sbatch, but there is none here; run it where Slurm is.") from None
    except subprocess.TimeoutExpired:
        raise InputError(
            f"sbatch gave no answer within {MOST_SECONDS} s; ask squeue whether the job is there."
        ) from None
    said = " ".join((done.stderr or done.stdout).split())
    require(done.returncode == 0, f"sbatch must take {folder.script}, but it says: {said}; change the options.")
    return done.stdout.strip().split(";")[0]


CONNECT_SECONDS = 30
"""How long a scheduler may take to answer [s]."""


def run_on_dask(
    folder: SeriesFolder, address: str, retry: bool = False, on_task: Callable[[TaskState], None] = lambda state: None
) -> Counts:
    """Do all tasks that are left on the workers of the cluster at `address`, which see the same folder under the same
    path and have holosplat; how far all tasks are then. Ctrl-C takes back what has not begun, and is passed on.

    Errors: `MissingError` without the extra, `InputError` where no scheduler answers.
    """
    try:
        from distributed import Client, as_completed
    except ImportError:
        raise MissingError(
            "--dask needs the package dask[distributed], which is not here; install it: pip install 'holosplat[dask]'."
        ) from None
    numbers = [state.number for state in remaining(states(folder), retry)]
    try:
        client = Client(address, timeout=CONNECT_SECONDS)
    except (OSError, ValueError) as error:
        said = str(error).split("\n", 1)[0]
        raise InputError(f"--dask must be the address of a Dask scheduler, but {address!r} gives: {said}.") from None
    with client:
        futures = client.map(_on_worker, [str(folder.path.resolve())] * len(numbers), numbers, pure=False)
        try:
            for future in as_completed(futures):
                state = future.result()
                if state is not None:
                    on_task(state)
        except KeyboardInterrupt:
            client.cancel(futures)
            raise
    return counted(states(folder))


def _on_worker(path: str, number: int) -> TaskState | None:
    """One task; None where another process does it."""
    try:
        return run_task(SeriesFolder(Path(path)), number)
    except TakenError:
        return None


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


def remaining(states: Sequence[TaskState], retry: bool) -> list[TaskState]:
    """The tasks that are left, and, with `retry`, those that failed."""
    return [state for state in states if state.state == "left" or (retry and state.state == "failed")]


def run_left(
    folder: SeriesFolder,
    retry: bool = False,
    on_row: OnRow = nothing,
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

    for state in remaining(asked(), retry):
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
