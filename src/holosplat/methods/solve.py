"""From a task and a method to what is run: the kind of matter is decided, and `auto` chooses a method."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from ..backends import coarse_work, resolve
from ..checks import require
from ..inference import Decision
from ..matter import MaterialPrior, MatterKind
from ..representations import Stored
from ..scan import Scan
from ..tables import to_table
from .auto import Auto
from .gaussians import Gaussians
from .illumination import prepared
from .levels import LEVELS, NAME, SEVERAL, decide_matter, kind_of, ratio_of_one
from .method import Method, Task, first_of_task, solve_stages
from .trials import unseen_kinds
from .uncertain import Determined, Uncertain, determine, placed, told


@dataclass(frozen=True)
class Settled:
    """What is run. method: with stages of its own; matter: of which kind it is taken to be, by a `decision`; constants:
    what was uncertain, by the frames."""

    method: Method
    matter: MatterKind
    decision: Decision
    constants: tuple[Determined, ...] = ()

    @classmethod
    def again(cls, method: Method, table: Mapping[str, Any]) -> Settled:
        """What was settled before, by the `table` of it in a run folder."""
        matter: MatterKind = "continuous" if table["matter"] == "continuous" else "levels"
        constants = tuple(Determined.from_dict(each) for each in table.get("constants", ()))
        return cls(
            method.suited(matter) if isinstance(method, Auto) else method,
            matter,
            Decision.from_dict(table["why"]),
            constants,
        )

    def as_table(self) -> dict[str, Any]:
        """Plain values, which `again` takes."""
        constants = [to_table(each) for each in self.constants]
        return {
            "method": self.method.kind,
            "matter": self.matter,
            "why": self.decision.as_dict(),
            "constants": constants,
        }

    def placed(self, scan: Scan) -> Scan:
        """`scan` at the distance and energy that were found."""
        return placed(scan, self.constants)

    def task(self, task: Task) -> Task:
        """`task` with what was settled."""
        return replace(told(task, self.constants), matter=self.matter, decisions=(*task.decisions, self.decision))


@coarse_work()
def settled(
    method: Method, task: Task, matter: MatterKind | None = None, uncertain: Uncertain | None = None
) -> Settled:
    """The method to run for `task`, the kind of its matter (`matter`, or what the frames say), and what is `uncertain`.

    Where nothing is known, δ/β of continuous matter is uncertain, too; for `Auto` that of one level. Errors:
    those of `determine`.
    """
    kinds, why = _possible(method, task.prior)
    if isinstance(method, Gaussians):
        resolve(method.fit.backend)  # before the decision, which takes its time
    constants = determine(task, uncertain or Uncertain())
    task = told(task, constants)
    if matter:
        decision = Decision(NAME, matter, "told")
    elif len(kinds) == 1:
        decision = Decision(NAME, SEVERAL if len(task.prior.materials) > 1 else kinds[0], why)
    elif method.wants_levels:
        decision = decide_matter(task, _kinds(method, task))
    else:
        decision = Decision(NAME, "levels", "no matter to the method")
    kind = kind_of(decision.choice)
    one = kind == "continuous"
    if isinstance(method, Auto):
        one = one or (decision.choice == LEVELS[0] and len(decision.compared) > 0)
        method = method.suited(kind)
    if one and not task.prior.fixes_ratio:
        constants = (*constants, ratio_of_one(task, first_of_task(task)))
    return Settled(method, kind, decision, constants)


def _possible(method: Method, prior: MaterialPrior) -> tuple[tuple[MatterKind, ...], str]:
    """The kinds of matter that there can be, and why there are no others."""
    if len(prior.materials) > 1:
        return ("levels",), "several materials are known"
    if prior.two_sided:
        return ("continuous",), "matter lies on both sides of its medium"
    return method.kinds_of_matter, f"the method {method.kind} has no levels"


def require_possible(method: Method, prior: MaterialPrior, matter: MatterKind | None) -> None:
    """`InputError` for a kind of matter that the method, or the prior, cannot have."""
    kinds, why = _possible(method, prior)
    possible = matter is None or matter in kinds
    require(possible, f"--matter must be {kinds[0]} or auto, because {why}, but it is {matter}; leave it.")


def _kinds(method: Method, task: Task) -> Mapping[MatterKind, Method] | None:
    """The methods whose fits say of which kind matter is, where first volumes do not: of a known material always, for
    these alone would call cells in few views continuous; else those of `Auto`."""
    if isinstance(method, Auto):
        return method.kinds
    return {"levels": method, "continuous": method} if task.prior.materials else None


def solve(method: Method, task: Task, matter: MatterKind | None = None) -> Stored:
    """What `method` makes of `task` in memory, without a folder; Ctrl-C is passed on. matter: as for `settled`. Errors:
    those of `require_possible`."""
    require_possible(method, task.prior, matter)
    task = prepared(task, method)
    found = settled(method, task, matter)
    task = found.task(task)
    return solve_stages(found.method, task, unseen_kinds(task, found.method))
