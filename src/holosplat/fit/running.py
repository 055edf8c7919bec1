"""What a run asks of a fit, whatever drives it: steps that can be stopped, saved and gone on with."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from ..model import Model

Record = dict[str, float]
"""One row of metrics.csv."""


class Running(Protocol):
    """A fit in progress. `run` advances it; `state_dict` and `load` make it resumable (on a CPU bit for bit)."""

    step: int
    seconds: float
    backend: str

    @property
    def finished(self) -> bool:
        """Whether it has come to its end."""
        ...

    @property
    def stopped_early(self) -> bool:
        """Whether that was before all steps were done."""
        ...

    @property
    def best_step(self) -> int:
        """The step of the best state by validation frames; 0 without any."""
        ...

    @property
    def share(self) -> float:
        """How much of the work is done."""
        ...

    @property
    def oversample(self) -> int:
        """Wave samples a pixel."""
        ...

    @property
    def aside(self) -> int:
        """How many of the training frames are set aside for validation."""
        ...

    def result(self) -> Model:
        """The best model so far."""
        ...

    def resolved(self) -> dict[str, Any]:
        """What frames, noise and knowledge have made of the options."""
        ...

    def columns(self) -> list[str]:
        """Names of everything that a record may hold, in the order of metrics.csv."""
        ...

    def run(self, on_record: Callable[[Record], None], until: int | None = None) -> None:
        """Advance to the end (or to step `until`); Ctrl-C is held back until a step is complete."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """Everything that `load` needs to go on as if nothing had happened."""
        ...

    def load(self, state: dict[str, Any]) -> None:
        """Go back to a saved state."""
        ...
