"""From a task and a method to what is run: the kind of matter is decided, and `auto` chooses a method."""

from __future__ import annotations

from dataclasses import dataclass, replace

from ..backends import resolve
from ..baselines import HolographicTV
from ..checks import require
from ..matter import KnownTwo, MatterKind
from ..representations import Stored
from .auto import Auto
from .gaussians import Gaussians
from .levels import Decision, LevelTest, decide_matter
from .method import Method, Task, solve_stages


@dataclass(frozen=True)
class Settled:
    """What is run. method: with stages of its own; matter: of which kind it is taken to be; why: in words."""

    method: Method
    matter: MatterKind
    why: str

    @classmethod
    def again(cls, method: Method, matter: MatterKind, why: str) -> Settled:
        """What was settled before, by what is left of it in a run folder."""
        return cls(method.suited(matter) if isinstance(method, Auto) else method, matter, why)


def settled(method: Method, task: Task, matter: MatterKind | None = None) -> Settled:
    """The method to run for `task`, and the kind of its matter: `matter`, or what the frames say of it.

    Errors: `InputError` for continuous matter of two materials.
    """
    require(
        not (matter == "continuous" and isinstance(task.prior, KnownTwo)),
        "--matter must be levels or auto where two materials are known, but it is continuous; leave --second-material.",
    )
    if isinstance(method, Gaussians):
        resolve(method.fit.backend)  # before the decision, which takes its time
    if matter:
        decision = Decision(matter, "as you say")
    elif getattr(method, "wants_levels", True):
        decision = decide_matter(task, _levels(method))
    else:
        decision = Decision("levels", "it makes no difference to the method")
    if isinstance(method, Auto):
        method, decision = method.chosen(task, decision)
    return Settled(method, decision.matter, decision.why)


def _levels(method: Method) -> LevelTest:
    """How it is decided, by what computes the method."""
    if isinstance(method, Auto):
        return method.levels
    volume = getattr(method, "volume", None)
    return LevelTest().on_backend(volume.backend if isinstance(volume, HolographicTV) else "cpu")


def solve(method: Method, task: Task, matter: MatterKind | None = None) -> Stored:
    """What `method` makes of `task` in memory, without a folder; Ctrl-C is passed on. matter: as for `settled`."""
    found = settled(method, task, matter)
    return solve_stages(found.method, replace(task, matter=found.matter))
