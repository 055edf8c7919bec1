"""The version of this package, and the commit of its source tree."""

from __future__ import annotations

from functools import cache
from pathlib import Path

__version__ = "0.2.0"


@cache
def source_commit() -> str:
    """The commit of this package's source tree, with `-dirty` if it was changed; empty outside a git checkout."""
    import subprocess  # which most commands need not

    root = Path(__file__).resolve().parents[2]
    if not (root / ".git").exists():
        return ""
    command = ["git", "describe", "--always", "--dirty", "--abbrev=10", "--exclude=*"]
    try:
        shown = subprocess.run(command, capture_output=True, text=True, check=False, cwd=root)
    except OSError:  # git is not installed
        return ""
    return shown.stdout.strip()
