"""From a task and a method to what is run: the kind of matter is decided, and `auto` chooses a method."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from ..backends import resolve
from ..baselines import HolographicTV
from ..checks import require
from ..matter import KnownTwo, MatterKind
from ..representations import Stored
from ..scan import Scan
from ..tables import to_table
from .auto import Auto
from .gaussians import Gaussians
from .levels import Decision, LevelTest, decide_matter
from .method import Method, Task, solve_stages
from .still import prepared
from .uncertain import Determined, Uncertain, determine, likeliest_ratio, placed, told


@dataclass(frozen=True)
class Settled:
    """What is run. method: with stages of its own; matter: of which kind it is taken to be; why: in words; constants:
    what was uncertain, by the frames."""

    method: Method
    matter: MatterKind
    why: str
    constants: tuple[Determined, ...] = ()

    @classmethod
    def again(cls, method: Method, table: Mapping[str, Any]) -> Settled:
        """What was settled before, by the `table` of it in a run folder."""
        matter: MatterKind = "continuous" if table["matter"] == "continuous" else "levels"
        constants = tuple(Determined.from_dict(each) for each in table.get("constants", ()))
        return cls(method.suited(matter) if isinstance(method, Auto) else method, matter, table["why"], constants)

    def as_table(self) -> dict[str, Any]:
        """Plain values, which `again` takes."""
        constants = [to_table(each) for each in self.constants]
        return {"method": self.method.kind, "matter": self.matter, "why": self.why, "constants": constants}

    def placed(self, scan: Scan) -> Scan:
        """`scan` at the distance and energy that were found."""
        return placed(scan, self.constants)

    def task(self, task: Task) -> Task:
        """`task` with what was settled."""
        return replace(told(task, self.constants), matter=self.matter)


def settled(
    method: Method, task: Task, matter: MatterKind | None = None, uncertain: Uncertain | None = None
) -> Settled:
    """The method to run for `task`, the kind of its matter (`matter`, or what the frames say), and what is `uncertain`.

    Of continuous matter of which nothing is known, δ/β is uncertain, too. Errors: `InputError` for continuous matter of
    two materials, and those of `determine`.
    """
    require(
        not (matter == "continuous" and isinstance(task.prior, KnownTwo)),
        "--matter must be levels or auto where two materials are known, but it is continuous; leave --second-material.",
    )
    if isinstance(method, Gaussians):
        resolve(method.fit.backend)  # before the decision, which takes its time
    constants = determine(task, uncertain or Uncertain())
    task = told(task, constants)
    if matter:
        decision = Decision(matter, "as you say")
    elif getattr(method, "wants_levels", True):
        decision = decide_matter(task, _levels(method))
    else:
        decision = Decision("levels", "it makes no difference to the method")
    if isinstance(method, Auto):
        method, decision = method.chosen(task, decision)
    if decision.matter == "continuous" and not task.prior.fixes_ratio:
        constants = (*constants, likeliest_ratio(task))
    return Settled(method, decision.matter, decision.why, constants)


def _levels(method: Method) -> LevelTest:
    """How it is decided, by what computes the method."""
    if isinstance(method, Auto):
        return method.levels
    volume = getattr(method, "volume", None)
    return LevelTest().on_backend(volume.backend if isinstance(volume, HolographicTV) else "auto")


def solve(method: Method, task: Task, matter: MatterKind | None = None) -> Stored:
    """What `method` makes of `task` in memory, without a folder; Ctrl-C is passed on. matter: as for `settled`."""
    task = prepared(task, method)
    found = settled(method, task, matter)
    return solve_stages(found.method, found.task(task))
