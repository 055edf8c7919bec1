"""The best state of a run: what a stage ends with must explain the frames better than what came before."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, cast

import torch
from torch import Tensor

from ..matter import DeltaBeta
from ..representations import KINDS, Stored
from ..scan import Exposures, Scan
from .cross_validation import MissingMatter

LOST = 0.5
"""What takes the place of all others must not leave more than this share of all matter unexplained, and twice what the
best of them does: then a prior has wiped out matter that the frames show."""
CLEARLY = 0.95
"""An earlier state is kept if it leaves less than this part of the matter that a later one leaves unexplained, and no
more of the contrast: differences in fitted frames may also be noise."""


@dataclass(frozen=True)
class State:
    """name: of the stage that made it, or `start`; object: what it made; oversample: wave samples a pixel; share: of
    all matter that it leaves unexplained in the training frames; contrast: the same of their contrast; exposures: where
    these were."""

    name: str
    object: Stored
    oversample: int
    share: float
    contrast: float
    exposures: Exposures


@dataclass
class Keeper:
    """Looks at the states of a run on its training frames, and keeps the best one (see `MissingMatter`).

    mixed: whether states of different kinds of Objects compete; else those of another kind than the latest are out, for
    who asks for surfaces wants surfaces

    Shares are compared with the noise that is in them. Beyond it nothing could be compared: what is freer follows the
    noise of the frames that it is fitted to, and a smooth volume leaves less than that of cells that it does not show.
    """

    train: Scan
    mixed: bool = False
    best: State | None = None
    judged: dict[str, float] = field(default_factory=dict)
    """Share of all matter that each state leaves unexplained, by its name."""
    _judge: MissingMatter | None = None

    def moved(self, train: Scan) -> None:
        """The training frames are elsewhere from now on."""
        if train.exposures is not self.train.exposures:
            self.train, self._judge = train, None

    def look_after(self, stage: object, name: str, found: Stored, oversample: int) -> None:
        """Take in what the fit of a stage ended with; it may say `likelier` (see `look`)."""
        self.look(name, found, oversample, fitted=not getattr(stage, "likelier", False))

    def look(self, name: str, found: Stored, oversample: int, fitted: bool = True) -> None:
        """Take in the latest state. What is not `fitted` is a step of the method, and takes the place of all others
        unless it has lost the matter (`LOST`)."""
        if self._judge is None:
            self._judge = MissingMatter(self.train, _material(self.best.object if self.best else found))
        share, contrast = self._judge.shares(found, oversample)
        self.judged[name] = share
        if self._wins(found, share, contrast, fitted):
            self.best = State(name, found, oversample, share, contrast, self.train.exposures)

    def _wins(self, found: Stored, share: float, contrast: float, fitted: bool) -> bool:
        best = self.best
        if best is None:
            return True
        same = best.object.kind == found.kind
        if not (fitted and (self.mixed or same)):
            return not (same and share > LOST and share > 2 * best.share)
        return CLEARLY * share <= best.share or contrast < best.contrast

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
            "share": best.share,
            "contrast": best.contrast,
            "placed": where(best.exposures),
            "judged": dict(self.judged),
        }

    def load(self, saved: dict[str, Any] | None) -> None:
        """Go back to a saved state."""
        if saved is not None:
            found = KINDS[saved["kind"]].from_state(saved["state"])
            self.best = State(
                saved["name"],
                cast(Stored, found),
                saved["oversample"],
                saved["share"],
                saved["contrast"],
                placed_at(self.train.exposures, saved.get("placed", where(self.train.exposures))),
            )
            self.judged = dict(saved["judged"])


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
