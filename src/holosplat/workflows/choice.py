"""What was decided in a run, and which of its states was kept."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from ..inference import Decision
from ..matter import MatterKind


@dataclass(frozen=True)
class Choice:
    """What was decided in a run.

    matter: of which kind it was taken to be; judged: share of all matter that each state leaves unexplained in the
    training frames, by its name; kept: the name of the state that is the result, empty where the run was interrupted;
    begun: what it began with and why, in a sentence, where a network was asked; decisions: between hypotheses
    """

    matter: MatterKind = "levels"
    judged: Mapping[str, float] = field(default_factory=dict)
    kept: str = ""
    begun: str = ""
    decisions: tuple[Decision, ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """Entries of summary.json; `read` reads them."""
        decided = {"matter": self.matter} | ({"begun": self.begun} if self.begun else {})
        decisions = [each.as_dict() for each in self.decisions]
        return {"decided": decided, "decisions": decisions, "kept": self.kept, "unexplained": dict(self.judged)}

    @classmethod
    def read(cls, summary: Mapping[str, Any]) -> Choice:
        """What a summary.json says of it; that of older versions says nothing."""
        decided = summary.get("decided", {})
        matter: MatterKind = "continuous" if decided.get("matter") == "continuous" else "levels"
        decisions = tuple(Decision.from_dict(each) for each in summary.get("decisions", ()))
        kept, begun = str(summary.get("kept", "")), str(decided.get("begun", ""))
        return cls(matter, summary.get("unexplained", {}), kept, begun, decisions)

    def lines(self) -> list[str]:
        """The same as a few lines of text."""
        lines = [each.line for each in self.decisions]
        lines += [f"start: {self.begun}"] if self.begun else []
        if len(self.judged) > 1 and self.kept and self.kept != next((d.choice for d in self.decisions[-1:]), ""):
            lines.append(f"result: {self.kept}")
        return lines
