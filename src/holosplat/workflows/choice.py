"""What was decided in a run, and its entries in summary.json."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from ..inference import Decision
from ..matter import MatterKind

if TYPE_CHECKING:
    from ..methods import Task

GAUGE = (
    "against {}: δ and β are differences, zero where it is alone; a constant phase is in no frame, and even absorption "
    "of what fills the field counts as light"
)
"""The note on matter in a medium."""


@dataclass(frozen=True)
class Choice:
    """What was decided in a run.

    matter: of which kind it was taken to be; judged: share of all matter that each state leaves unexplained in the
    training frames, by its name; kept: the name of the state that is the result, empty where the run was interrupted;
    begun: what it began with and why, in a sentence, where a network was asked; decisions: between hypotheses; against:
    the medium that δ and β are differences to, empty for vacuum
    """

    matter: MatterKind = "levels"
    judged: Mapping[str, float] = field(default_factory=dict)
    kept: str = ""
    begun: str = ""
    decisions: tuple[Decision, ...] = ()
    against: str = ""

    @classmethod
    def of(cls, task: Task, judged: Mapping[str, float], kept: str, decisions: tuple[Decision, ...]) -> Choice:
        """What was decided of a `task`."""
        return cls(task.matter, judged, kept, decisions=decisions, against=task.prior.against)

    def as_dict(self) -> dict[str, Any]:
        """Entries of summary.json; `read` reads them."""
        told = {"begun": self.begun, "against": self.against}
        decided = {"matter": self.matter} | {name: said for name, said in told.items() if said}
        decisions = [each.as_dict() for each in self.decisions]
        return {"decided": decided, "decisions": decisions, "kept": self.kept, "unexplained": dict(self.judged)}

    @classmethod
    def read(cls, summary: Mapping[str, Any]) -> Choice:
        """What a summary.json says of it; that of older versions says nothing."""
        decided = summary.get("decided", {})
        matter: MatterKind = "continuous" if decided.get("matter") == "continuous" else "levels"
        decisions = tuple(Decision.from_dict(each) for each in summary.get("decisions", ()))
        kept, begun = str(summary.get("kept", "")), str(decided.get("begun", ""))
        against = str(decided.get("against", ""))
        return cls(matter, summary.get("unexplained", {}), kept, begun, decisions, against)

    def lines(self) -> list[str]:
        """The same as a few lines of text."""
        lines = [each.line for each in self.decisions]
        lines += [GAUGE.format(self.against)] if self.against else []
        lines += [f"start: {self.begun}"] if self.begun else []
        if len(self.judged) > 1 and self.kept and self.kept != next((d.choice for d in self.decisions[-1:]), ""):
            lines.append(f"result: {self.kept}")
        return lines
