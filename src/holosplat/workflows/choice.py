"""What was decided in a run, and which of its states was kept."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from ..matter import MatterKind
from ..methods.auto import VolumeWhereUnexplained
from ..units import in_percent


@dataclass(frozen=True)
class Choice:
    """What was decided in a run.

    matter: of which kind it was taken to be; why: in words; judged: share of all matter that each state leaves
    unexplained in the training frames, by its name; kept: the name of the state that is the result, empty where the run
    was interrupted; begun: what it began with and why, in a sentence, where a network was asked
    """

    matter: MatterKind = "levels"
    why: str = ""
    judged: Mapping[str, float] = field(default_factory=dict)
    kept: str = ""
    begun: str = ""

    def as_dict(self) -> dict[str, Any]:
        """Entries of summary.json; `read` reads them."""
        decided = {"matter": self.matter, "why": self.why} | ({"begun": self.begun} if self.begun else {})
        return {"decided": decided, "kept": self.kept, "unexplained": dict(self.judged)}

    @classmethod
    def read(cls, summary: Mapping[str, Any]) -> Choice:
        """What a summary.json says of it; that of older versions says nothing."""
        decided = summary.get("decided", {})
        matter: MatterKind = "continuous" if decided.get("matter") == "continuous" else "levels"
        why, begun = (str(decided.get(name, "")) for name in ("why", "begun"))
        return cls(matter, why, summary.get("unexplained", {}), str(summary.get("kept", "")), begun)

    def lines(self) -> list[str]:
        """The same as a few lines of text."""
        lines = [f"matter: {self.matter} ({self.why})"] if self.why else []
        lines += [f"start: {self.begun}"] if self.begun else []
        if self.kept and len(self.judged) > 1:
            shares = ", ".join(f"{name} {in_percent(share)}" for name, share in self.judged.items())
            lines.append(f"kept: {self.kept} (matter that training frames leave unexplained: {shares})")
        if self.matter == "levels" and self.kept == VolumeWhereUnexplained.name and "fit" in self.judged:
            lines.append("bodies of one level explain these frames badly: there may be several levels, or none")
        return lines
