"""Options of a series and of Slurm, quick to import for the help of the command line."""

from __future__ import annotations

import re
from dataclasses import dataclass

from ..checks import require
from ..ranges import Natural, ranged

WORD = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.,:+-]*")
"""What partitions, accounts, memory and times may be: nothing that a shell or sbatch would read otherwise."""


@dataclass(frozen=True)
@ranged
class Cut:
    """How times are cut into tasks."""

    window: Natural = 16
    """Times of a task. With --warm the first of them takes as long as ten others, which go on from the one before."""
    overlap: int = 0
    """Times before its own that a task also does: a run-in, and what says how well tasks agree."""

    def __post_init__(self) -> None:
        require(self.overlap >= 0, f"overlap must not be negative, but it is {self.overlap}.")
        require(self.overlap <= self.window, f"overlap must be at most the window, {self.window}, but is larger.")


@dataclass(frozen=True)
@ranged
class Slurm:
    """Resources of an array script of Slurm; empty ones are left to the cluster."""

    partition: str = ""
    """Partition (default: the cluster's)."""
    time: str = "01:00:00"
    """Time limit of a job; a minute before, its task is saved."""
    memory: str = ""
    """Memory of a job, such as 8G (default: the cluster's; some refuse to be asked)."""
    cpus: Natural = 4
    """Cores of a job, and its threads."""
    block: Natural = 1
    """Tasks of a job, one after another: they share its start, which takes some seconds, and its time limit."""
    limit: int = 0
    """Jobs that run at the same time, at most (0: as many as there is room for)."""
    account: str = ""
    """Account that is charged."""
    gres: str = ""
    """Generic resources, such as gpu:1."""

    def __post_init__(self) -> None:
        for name in ("partition", "time", "memory", "account", "gres"):
            value = getattr(self, name)
            fits = not value or WORD.fullmatch(value) is not None
            require(fits, f"{name} must be a word of letters, digits and -_.,:+, but it is {value!r}; correct it.")
        require(bool(self.time), "time must be a limit such as 01:00:00, but it is empty; give one.")
        require(self.limit >= 0, f"limit must be 0 (none) or more, but it is {self.limit}.")
