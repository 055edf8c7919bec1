"""What a method of reconstruction is: options that know the stages which lead from frames to an Object."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Protocol, runtime_checkable

from ..fit.loop import Fit
from ..matter import MaterialPrior
from ..progress import Advance, Progress
from ..representations import KINDS, Stored
from ..scan import Scan


def quiet(stage: str, fraction: float) -> None:
    """Progress that nobody looks at."""


@dataclass(frozen=True)
class Task:
    """What a method is given.

    scan: the training frames, of one time
    prior: what is known of the matter
    seed: seed of everything random
    on_progress: called with (stage, fraction done of it)
    """

    scan: Scan
    prior: MaterialPrior
    seed: int = 0
    on_progress: Progress = quiet

    def report(self, stage: str) -> Advance:
        """Progress of one stage: a function of the fraction done."""
        return lambda fraction: self.on_progress(stage, fraction)


class Stage(Protocol):
    """A piece of a reconstruction: an Object is made, and then perhaps fitted."""

    @property
    def name(self) -> str:
        """For progress and summaries."""
        ...

    def start(self, task: Task, before: Stored | None) -> Stored:
        """The Object that this stage begins with; before: what the stage before ended with. It cannot be resumed."""
        ...

    def fit(self, task: Task, start: Stored) -> Fit | None:
        """The fit of `start`, made ready, or None where nothing is fitted."""
        ...


@runtime_checkable
class Method(Protocol):
    """Options of a method, as a frozen dataclass; `kind` is its name in tables, files and on the command line."""

    kind: ClassVar[str]

    def stages(self) -> Sequence[Stage]:
        """The stages, in their order; each resumes by itself."""
        ...


def finished(fit: Fit) -> Stored:
    """The object that a fit ended with, in main memory."""
    found = fit.result().object
    assert isinstance(found, tuple(KINDS.values()))
    return found.on("reference" if fit.backend == "reference" else "cpu")


def run_quietly(fit: Fit, report: Advance) -> Stored:
    """Run a fit to its end without keeping records; what it ended with. Ctrl-C is passed on."""
    fit.run(lambda record: report(min(1.0, fit.schedule.share(fit.step, fit.seconds))))
    return finished(fit)


def solve(method: Method, task: Task) -> Stored:
    """Run all stages of `method` in memory, without a folder; Ctrl-C is passed on."""
    found: Stored | None = None
    for stage in method.stages():
        found = stage.start(task, found)
        fit = stage.fit(task, found)
        if fit is not None:
            found = run_quietly(fit, task.report(stage.name))
    assert found is not None
    return found
