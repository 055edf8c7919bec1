"""What binds the files of a run to each other: its name, and a hash of what it was started with."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..checks import require

RUN, CONFIG_SUM = "run", "config_sha256"
"""Entries, or attributes, by which a file says of which run it is, and of which `config_sum`."""

RESUMED_WITH = {
    "scan_hash": "scan file",
    "method": "method and settings (--method, --preset, --config, --set, or the options of track)",
    "prior": "material (--material, --delta-beta)",
    "matter": "kind of matter (--matter)",
    "seed": "seed (--seed)",
    "light": "light (--light, --air)",
    "uncertain": "ranges (--distance, --energy-kev, --delta-beta)",
    "refine": "refinement (--refine, --uncertain-…)",
}
"""What must not change between the parts of a run, as messages call it."""


def config_sum(config: Mapping[str, Any]) -> str:
    """The SHA-256 of what a run was started with: the entries `RESUMED_WITH` of config.json, as JSON with sorted names
    and without spaces."""
    bound = {name: config.get(name) for name in RESUMED_WITH}
    return hashlib.sha256(json.dumps(bound, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def require_bound(path: Path, said: Mapping[str, Any], marks: Mapping[str, str], config: Path) -> None:
    """`InputError` if the file `path` says that it is of another run, or of other settings, than the `marks` of the run
    in the file `config`. What says nothing, as files of older versions do, passes."""
    require(
        str(said.get(RUN, marks[RUN])) == marks[RUN],
        f"{path} must be of the run in {config}, but it is of another one; bring back its own, or start anew.",
    )
    require(
        str(said.get(CONFIG_SUM, marks[CONFIG_SUM])) == marks[CONFIG_SUM],
        f"{path} must be of a run with the settings in {config}, but it was written with others; bring back the "
        f"{config.name} of that run, or start anew.",
    )
