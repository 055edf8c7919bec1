"""What a method of reconstruction is: options that know the stages which lead from frames to an Object."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar, Protocol, runtime_checkable

from ..fit.loop import Fit
from ..matter import MaterialPrior
from ..scan import Scan
from ..volume import Object

Progress = Callable[[str, float], None]
"""Called with (stage, fraction done of it)."""


def quiet(stage: str, fraction: float) -> None:
    """Progress that nobody looks at."""


@dataclass(frozen=True)
class Task:
    """What a method is given.

    scan: the training frames, of one time; prior: what is known of the matter; seed: of everything random; on_progress:
    called with (stage, fraction done of it).
    """

    scan: Scan
    prior: MaterialPrior
    seed: int = 0
    on_progress: Progress = quiet

    def report(self, stage: str) -> Callable[[float], None]:
        """Progress of one stage: a function of the fraction done."""
        return lambda fraction: self.on_progress(stage, fraction)


class Stage(Protocol):
    """A piece of a reconstruction: an Object is made, and then perhaps fitted."""

    name: str
    """For progress and summaries."""

    def start(self, task: Task, before: Object | None) -> Object:
        """The Object that this stage begins with; before: what the stage before ended with. It cannot be resumed."""
        ...

    def fit(self, task: Task, start: Object) -> Fit | None:
        """The fit of `start`, made ready, or None where nothing is fitted."""
        ...


@runtime_checkable
class Method(Protocol):
    """Options of a method, as a frozen dataclass; `kind` is its name in tables, files and on the command line."""

    kind: ClassVar[str]

    def stages(self) -> Sequence[Stage]:
        """The stages, in their order; each resumes by itself."""
        ...


def finished(fit: Fit) -> Object:
    """The object that a fit ended with, in main memory."""
    found = fit.result().object
    move = getattr(found, "on", None)
    return move("reference" if fit.backend == "reference" else "cpu") if move else found


def solve(method: Method, task: Task) -> Object:
    """Run all stages of `method` in memory, without a folder; Ctrl-C is passed on."""
    found: Object | None = None
    for stage in method.stages():
        found = stage.start(task, found)
        fit = stage.fit(task, found)
        if fit is not None:
            report, share = task.report(stage.name), fit.schedule.share
            fit.run(lambda record, fit=fit: report(min(1.0, share(fit.step, fit.seconds))))
            found = finished(fit)
    assert found is not None
    return found
