"""The status of a run by its folder: its last checkpoint and metrics, and a summary for `holosplat info`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ..checks import as_written
from ..io.facts import Facts
from ..io.json import read_json
from ..io.lock import Writer, writer_of
from ..representations import KINDS, MovingSurfaces, Stored, VoxelGrid
from ..units import in_percent
from .reconstruction import Choice
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


def facts_of_run(folder: RunFolder) -> Facts:
    """The facts of a run, begun or finished. Errors: `InputError` for files that are damaged, or of another run."""
    with as_written(folder.path, "a run as it was written"):
        return _facts(folder)


def _facts(folder: RunFolder) -> Facts:
    config, summary = folder.read_config(), folder.read_summary() if folder.summary.is_file() else {}
    source = str(read_json(folder.source).get("scan", "")) if folder.source.is_file() else ""
    versions = config.get("versions", {})
    rows = {"what": f"a run of holosplat {versions.get('holosplat', '')}".rstrip(), "made from": source or "not known"}
    rows |= _result(summary) if summary else {"state": "begun; no result yet"}
    done, object_there = bool(summary.get("finished")), folder.result().is_file()
    scan = source or "SCAN"
    commands = []
    if not done:
        commands.append(f"holosplat reconstruct {scan} --out {folder.path} --resume, with the options of before")
    if object_there:
        commands += [
            f"holosplat evaluate {folder.path} --truth VOLUME",
            f"holosplat export {folder.path} --volume v.h5",
        ]
        commands += [f"holosplat view {folder.path}"]
    missing = [] if source else [f"{folder.path} does not say which scan it is of; name it with --scan."]
    return Facts(rows, tuple(missing), tuple(commands))


def _result(summary: dict) -> dict[str, str]:
    """What summary.json says, by the names of rows."""
    seconds = {name: float(value) for name, value in summary.get("timing_s", {}).items()}
    detector, verdict, total = (summary.get(name, {}) for name in ("detector", "verdict", "total"))
    rows = {"state": "finished" if summary.get("finished") else "interrupted; what is there can be used"}
    rows["method"] = f"{summary.get('method', 'gaussians')}; object: {summary.get('size', summary.get('kind', ''))}"
    if detector:
        size = f"{detector['rows']} × {detector['columns']} pixels of {1e6 * detector['pixel_size_m']:.4g} µm"
        rows["frames"] = f"{size} at {summary.get('energy_kev', 0):g} keV"
    rows["verdict"] = verdict.get("words", "none was made")
    rows |= {f"verdict {n}": text for n, text in enumerate(verdict.get("reasons", ()), 1)}
    judged = Choice.read(summary).judged
    shares = ", ".join(f"{name} {in_percent(float(share))}" for name, share in judged.items())
    rows |= {"scores": f"matter that training frames leave unexplained: {shares}"} if shares else {}
    rows |= {"total": total["words"]} if "words" in total else {}
    stages = ", ".join(f"{name} {value:.3g} s" for name, value in seconds.items())
    rows["time"] = f"{sum(seconds.values()):.3g} s ({stages}) on {summary.get('device', 'an unknown device')}"
    return rows
