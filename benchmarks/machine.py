"""What benchmarks say of the machine and the tree they ran on."""

from __future__ import annotations

import subprocess
from pathlib import Path


def _described() -> str:
    command = ["git", "describe", "--always", "--dirty", "--abbrev=7", "--exclude=*"]
    shown = subprocess.run(command, capture_output=True, text=True, check=False, cwd=Path(__file__).parent)
    return shown.stdout.strip() or "unknown"


AT_THE_START = _described()
"""Before a table is written, which is part of the tree."""


def commit() -> str:
    """The commit that is measured, with a mark if the tree was changed."""
    return AT_THE_START


def memory_megabytes(key: str) -> float:
    """MB of this process: `VmRSS` now, `VmHWM` at its peak (ru_maxrss has the parent's in it). Linux only."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return 1024e-6 * int(next(line.split()[1] for line in lines if line.startswith(key + ":")))
