"""Clusters for the tasks of a series: a Slurm array script, and dask."""

from __future__ import annotations

import shlex
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from ..checks import InputError, MissingError, require
from ..io.atomic import atomic_path
from ..io.lock import TakenError
from .folder import SeriesFolder, TaskState
from .run import PROGRAM, Counts, counted, states
from .settings import Slurm
from .task import run_task

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
    wanted = ("left", "failed") if retry else ("left",)
    numbers = [state.number for state in states(folder) if state.state in wanted]
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
    wanted = ("left", "failed") if retry else ("left",)
    numbers = [state.number for state in states(folder) if state.state in wanted]
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
