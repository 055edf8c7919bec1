"""The best state of a run: what a stage ends with must explain the frames better than what came before."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any, cast

import torch
from torch import Tensor

from ..inference import Compared, Decision, Score
from ..matter import DeltaBeta
from ..representations import KINDS, Stored
from ..scan import Exposures, Scan
from .cross_validation import MissingMatter, predicted_frames

NAME = "result"
BY = "training frames"

Unseen = Callable[[str, str], Decision | None]
"""Which of two kinds of Objects predicts unseen frames, the null first; None where that cannot be compared."""


@dataclass(frozen=True)
class State:
    """name: of the stage that made it, or `start`; object: what it made; oversample: wave samples a pixel; exposures:
    where the frames were; predicted: [V, H, W] frames of it there."""

    name: str
    object: Stored
    oversample: int
    exposures: Exposures
    predicted: Tensor

    @classmethod
    def of(cls, name: str, found: Stored, oversample: int, exposures: Exposures) -> State:
        """With the frames that `found` predicts."""
        return cls(name, found, oversample, exposures, predicted_frames(exposures, found, oversample))


@dataclass
class Keeper:
    """Looks at the states of a run on its training frames, and keeps the best one.

    mixed: whether states of different kinds of Objects compete; else those of another kind than the latest are out, for
    who asks for surfaces wants surfaces

    unseen: decides between two kinds; None, or where it tells nothing: training frames do

    The latest state is the null: an earlier one is kept if it explains the frames better by the policy of `Compared`.
    One of another kind, whose freedom is another, must also predict unseen frames better, where `unseen` tells that.
    """

    train: Scan
    mixed: bool = False
    unseen: Unseen | None = None
    best: State | None = None
    judged: dict[str, float] = field(default_factory=dict)
    """Share of all matter that each state leaves unexplained (`MissingMatter`), by its name."""
    compared: list[Compared] = field(default_factory=list)
    """Every earlier state beside the one that came after it."""
    by: str = BY
    """By which frames."""
    _judge: MissingMatter | None = None

    @property
    def decisions(self) -> tuple[Decision, ...]:
        """Which state was kept, where some competed."""
        compared, best = tuple(self.compared), self.best
        return (Decision(NAME, best.name, self.by, compared),) if best and compared else ()

    def look(self, name: str, found: Stored, oversample: int, fitted: bool = True, train: Scan | None = None) -> None:
        """Take in the latest state. What is not `fitted` is a step of the method, and takes the place of all others
        unless it has lost the matter. train: the training frames, where they are elsewhere from now on."""
        if train is not None and train.exposures is not self.train.exposures:
            self.train, self._judge = train, None
        if self._judge is None:
            self._judge = MissingMatter(self.train, _material(self.best.object if self.best else found))
        state = State.of(name, found, oversample, self.train.exposures)
        self.judged[name] = self._judge.share(state.predicted)
        if self._wins(state, fitted):
            self.best = state

    def _wins(self, latest: State, fitted: bool) -> bool:
        best = self.best
        if best is None:
            return True
        same = best.object.kind == latest.object.kind
        earlier, later = (Score.of(self.train.left(each.predicted)) for each in (best, latest))
        compared = Compared(best.name, *earlier.gain_over(later))
        if not (fitted and (self.mixed or same)):
            return not (same and compared.wins and _lost(latest.predicted, best.predicted))
        if compared.wins and not same and self.unseen is not None:
            decision = self.unseen(latest.object.kind, best.object.kind)
            if decision is not None:
                compared = replace(decision.compared[0], name=best.name)
                self.by = f"{BY}; between kinds {decision.by}"
        self.compared.append(compared)
        return not compared.wins

    def state_dict(self) -> dict[str, Any] | None:
        """What `load` needs; None before the first state."""
        best = self.best
        if best is None:
            return None
        return {
            "name": best.name,
            "kind": best.object.kind,
            "state": best.object.state(),
            "oversample": best.oversample,
            "placed": where(best.exposures),
            "judged": dict(self.judged),
            "compared": [asdict(each) for each in self.compared],
            "by": self.by,
        }

    def load(self, saved: dict[str, Any] | None) -> None:
        """Go back to a saved state."""
        if saved is not None:
            found = cast(Stored, KINDS[saved["kind"]].from_state(saved["state"]))
            exposures = placed_at(self.train.exposures, saved.get("placed", where(self.train.exposures)))
            self.best = State.of(saved["name"], found, saved["oversample"], exposures)
            self.judged = dict(saved["judged"])
            self.compared = [Compared(**each) for each in saved["compared"]]
            self.by = saved.get("by", BY)


def where(exposures: Exposures) -> dict[str, Tensor]:
    """What a fit of the geometry changes of exposures, as a checkpoint holds it."""
    views = exposures.views
    arrays = {"rotations": views.rotations, "shifts": views.shifts, "distance": exposures.distance}
    arrays["pixel_sizes"] = views.pixel_sizes
    return {name: torch.from_numpy(array) for name, array in arrays.items()}


def placed_at(exposures: Exposures, saved: Mapping[str, Tensor]) -> Exposures:
    """`exposures` where a checkpoint says."""
    planned, scales = exposures.views, saved["pixel_sizes"].numpy() / exposures.views.pitch
    views = replace(planned, rotations=saved["rotations"].numpy(), shifts=saved["shifts"].numpy(), scales=scales)
    return replace(exposures, views=views, distance=saved["distance"].numpy())


def _material(found: Stored) -> DeltaBeta:
    return DeltaBeta(found.matter.delta, found.matter.beta)


def _lost(predicted: Tensor, before: Tensor) -> bool:
    """Whether frames [V, H, W] are nearer to empty ones than to those that were predicted `before`: then a prior has
    wiped out matter that the frames show."""
    return float((predicted - 1).double().square().sum()) < float((predicted - before).double().square().sum())
