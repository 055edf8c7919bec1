"""All tables of the documentation: what makes each, from which files of docs/data, and the command that makes these."""

from __future__ import annotations

from . import alignment, arena, learning, matter, measured, motion, moving, printed, runs, thesis
from .benchmark import TABLES, Table

__all__ = [
    "TABLES",
    "Table",
    "alignment",
    "arena",
    "learning",
    "matter",
    "measured",
    "motion",
    "moving",
    "printed",
    "runs",
    "thesis",
]
