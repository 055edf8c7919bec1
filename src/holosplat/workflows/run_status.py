"""The status of a run by its folder: its last checkpoint and metrics."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ..checks import as_written
from ..io.lock import Writer, writer_of
from ..representations import KINDS, MovingSurfaces, Stored, VoxelGrid
from .run_folder import RunFolder

OBJECT = "object."
"""How the names of an object's parameters begin in a fit."""


@dataclass(frozen=True)
class RunStatus:
    """stage: its name, empty before the first; step, loss: the last that are kept; object: None until there is one."""

    stage: str
    step: int | None = None
    loss: float | None = None
    object: Stored | None = None

    def lines(self) -> list[str]:
        """The same in words."""
        if not self.stage:
            return ["nothing is kept yet"]
        numbers = [] if self.step is None else [f"step {self.step}"]
        numbers += [] if self.loss is None else [f"loss {self.loss:.4g}"]
        return [f"stage: {self.stage}", *([", ".join(numbers)] if numbers else [])]


def fitted_by(folder: RunFolder) -> Writer | None:
    """The process that fits the run in `folder`; None where nobody writes there, or the run has ended."""
    writer = writer_of(folder.path)
    if writer is None or writer.gone or not folder.config.is_file():
        return None
    ended = folder.summary.is_file() and bool(folder.read_summary().get("finished"))
    return None if ended else writer


def read_status(folder: RunFolder) -> RunStatus:
    """The status of the run; `InputError` for files that are damaged, or of another run."""
    state = folder.load_checkpoint()
    if state is None:
        return RunStatus("")
    with as_written(folder.checkpoint, "a checkpoint of this run"):
        if "start" in state:  # of `reconstruct`, whose records are in metrics.csv
            stages, history = list(folder.read_config().get("resolved", {})), folder.history()
            record = {name: float(column[-1]) for name, column in history.items() if len(column)}
            stage = stages[-1] if stages else "fit"
        else:  # of matter or bodies in motion, which keep theirs beside the state
            records = state.get("records") or [{}]
            record, stage = records[-1], str(state.get("next") or f"{state.get('steps')} steps are done")
        step, loss = record.get("step"), record.get("loss")
        return RunStatus(stage, None if step is None else int(step), loss, _object_of(state))


def _object_of(state: Mapping[str, Any]) -> Stored | None:
    """The object of a checkpoint as its fit has made it; None where none is kept."""
    fit = state.get("fit") or {}
    if "volume" in fit:
        return VoxelGrid.from_state(fit["volume"])
    if "start" in state:
        begun = KINDS[state["start"]["kind"]].from_state(state["start"]["state"])
    elif state.get("bodies") is not None:
        begun = MovingSurfaces.from_state(state["bodies"])
    else:
        return None
    free = fit.get("trainable", {}).get("parameters", {})
    fitted = {name.removeprefix(OBJECT): value for name, value in free.items() if name.startswith(OBJECT)}
    return begun.with_parameters(fitted) if fitted and fitted.keys() <= begun.parameters().keys() else begun
