"""Provenance of weights: versions, machine, and the commit of the program."""

from __future__ import annotations

from ..version import source_commit
from ..workflows.provenance import environment


def made_by(device: str) -> dict[str, str]:
    """Versions, machine and commit, in one table; device: what computed it."""
    found = environment("cuda" if device == "cuda" else "cpu")
    return {**found["versions"], **found["machine"], "commit": source_commit() or "none: not a git checkout"}
