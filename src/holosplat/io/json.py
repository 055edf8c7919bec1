"""JSON tables: settings, summaries, and where things came from."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from ..tables import read_table
from .atomic import atomic_path


def write_json(path: Path, values: dict[str, Any]) -> None:
    """Write `values` as JSON, whole or not at all."""
    text = json.dumps(values, indent=2, allow_nan=False)
    with atomic_path(path) as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")


def read_json(path: Path) -> dict[str, Any]:
    """A JSON table; `InputError` if the file is missing or damaged."""
    return read_table(path)
