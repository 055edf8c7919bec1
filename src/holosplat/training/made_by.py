"""Who made weights: versions, machine, and the commit of the program."""

from __future__ import annotations

import subprocess
from pathlib import Path

from ..workflows.provenance import environment

UNKNOWN = "none: not a git checkout"


def made_by(device: str) -> dict[str, str]:
    """Versions, machine and commit, in one table; device: what computed it."""
    found = environment("cuda" if device == "cuda" else "cpu")
    return {**found["versions"], **found["machine"], "commit": commit()}


def commit() -> str:
    """The commit of the checkout that this program runs from, with a mark if files were changed."""
    where = Path(__file__).parent
    try:
        said = subprocess.run(
            ["git", "describe", "--always", "--dirty", "--abbrev=12", "--exclude=*"],
            cwd=where,
            capture_output=True,
            text=True,
            check=True,
        )
    except (OSError, subprocess.CalledProcessError):
        return UNKNOWN
    return said.stdout.strip()
