"""The tasks of a series on a Dask cluster that is there already."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from ..checks import InputError, MissingError
from ..io.lock import TakenError
from .folder import SeriesFolder, TaskState
from .run import Counts, counted, states
from .task import run_task

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
