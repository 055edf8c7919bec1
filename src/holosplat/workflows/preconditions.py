"""Preconditions of a run: scans that can be reconstructed, and folders that can be continued."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import is_dataclass
from typing import Any

from ..checks import as_written, require
from ..inference import Decision
from ..io.atomic import read_json
from ..io.provenance import sha256
from ..matter import MaterialPrior
from ..methods import Method, Task
from ..methods.continued import Continued
from ..methods.contrast import STAGE as SIGN
from ..methods.cross_validation import UNSEEN_RATIO
from ..methods.illumination import STAGE, Prepared
from ..methods.levels import RATIO, SHOWN
from ..methods.presets import SCHEMA
from ..methods.uncertain import Uncertain
from ..optics.background import LightOptions
from ..preprocess import require_relative
from ..scan import Scan
from ..tables import to_table
from .provenance import RESUMED_WITH
from .run_folder import OBJECT_SUM, RunFolder


def goes_on(folder: RunFolder | None, config: dict[str, Any], resume: bool) -> bool:
    """Whether a run in `folder` goes on. `InputError` for a folder that does not fit."""
    if folder is None:
        return False
    if resume and folder.config.is_file():
        require_same(folder, config)
        return True
    folder.require_new(advise_resume=not resume)
    return False


def is_complete(folder: RunFolder, config: dict[str, Any]) -> bool:
    """Whether the run of this `config` in `folder` has ended and its object is whole, so that nothing is left to do.
    `InputError` for a folder that does not fit."""
    if not (goes_on(folder, config, True) and folder.summary.is_file() and folder.object.is_file()):
        return False
    summary = folder.read_summary()
    return summary.get("finished") is True and summary.get(OBJECT_SUM) == sha256(folder.object)


def require_same(folder: RunFolder, config: dict[str, Any]) -> None:
    """`InputError` unless the run in `folder` was started with this `config`; another machine may go on with it."""
    with as_written(folder.config, "of a run that has begun"):
        old, same = folder.read_config(), json.loads(json.dumps(config))
        for name, default in (("light", LightOptions()), ("uncertain", Uncertain())):
            known = json.loads(json.dumps(to_table(default)))
            old[name] = known | old.get(name, {})  # what older versions did not know
        old.setdefault("refine", None)
        version = old.get("schema_version", 1)
        require(
            version == SCHEMA,
            f"{folder.path} was begun by a version of holosplat whose checkpoints differ (schema {version}, now "
            f"{SCHEMA}); start anew into another --out, with --config {folder.config}.",
        )
        for table in (old, same):
            _without_backends(table.get("method", {}))
            table.get("prior", {}).pop("medium", None)  # a name, which older versions did not keep
        for key, name in RESUMED_WITH.items():
            require(
                key not in same or old.get(key) == same[key],
                f"--resume needs the {name} that {folder.path} was started with; use the same, or another --out.",
            )


def _without_backends(table: Any) -> None:
    if isinstance(table, dict):
        table.pop("backend", None)
        for inner in table.values():
            _without_backends(inner)


def decisions_of(task: Task) -> dict[str, Any]:
    """Entries of config.json that `decided_before` reads: what was decided of sign, δ/β, light and noise, before
    the kind of matter."""
    taken = () if task.first is None else task.first.taken
    made = [each.as_dict() for each in task.decisions if each.name in (SIGN, UNSEEN_RATIO, RATIO, STAGE, SHOWN)]
    return {"light": list(taken), "decisions": made}


def decided_before(decided: Mapping[str, Any]) -> Prepared:
    """The decisions on sign, light and noise of a run that goes on, by the entry `decided` of its config.json."""
    made = tuple(Decision.from_dict(each) for each in decided["decisions"])
    return tuple(str(each) for each in decided["light"]), made


def decided_there(method: Method) -> Prepared | None:
    """What was decided of sign, light and noise by the run that `method` goes on from, which holds for the same matter
    a little later; None where it begins by itself, or no run is beside the file that it begins with."""
    if not isinstance(method, Continued):
        return None
    there = RunFolder(method.begin.parent).config
    return decided_before(read_json(there)["decided"]) if there.is_file() else None


FEWEST_COLUMNS = 11
"""Pixels across the axis that are a field of view; rows may be as few as one."""


def require_kinds(scan: Scan, prior: MaterialPrior, method: object) -> None:
    """`InputError` for values of other types, such as the names that the command line takes."""
    options = is_dataclass(method) and not isinstance(method, type)
    for name, value, fits, wanted in (
        ("scan", scan, isinstance(scan, Scan), "a Scan, as hs.read gives"),
        ("prior", prior, isinstance(prior, MaterialPrior), "a MaterialPrior, such as MaterialPrior.known(δ and β)"),
        ("method", method, options, "options of a method, such as Voxels() or preset('fast')"),
    ):
        require(fits, f"{name} must be {wanted}, but it is {value!r:.60}.")


def require_one_time(scan: Scan) -> None:
    """`InputError` for a time-resolved scan: one still volume cannot be all of its times."""
    times = scan.instants
    require(
        not scan.is_series,
        f"the scan must show one time, but its frames are of {len(times)}, from {times[0]:g} to {times[-1]:g} s, and "
        f"the reconstruction stands still; choose a time with --time-frame 0 … {len(times) - 1} (Scan.at_instant), or "
        "--motion flow, which finds out whether anything moves (Scan.as_static: nothing does).",
    )


def check_frames(train: Scan) -> None:
    """`InputError` for too few columns, and for frames that are not relative to the flat field."""
    h, w = train.views.shape
    require(
        w >= FEWEST_COLUMNS,
        f"frames must have at least {FEWEST_COLUMNS} columns, but they are {h} × {w} pixels; take a wider part.",
    )
    require_relative(train.frames)
