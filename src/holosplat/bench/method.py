"""A method of the benchmark: training frames and what is known of the matter in, an Object out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from ..progress import Progress
from ..scan import Scan
from ..volume import Object
from ..workflows.settings import MaterialPrior


@dataclass(frozen=True)
class Method:
    """name: for the command line and the table; family: its heading in the table; summary: one line of what it does;
    run: (training frames, prior, seed, on_progress) → Object, `InputError` with the reason where it cannot run."""

    name: str
    family: str
    summary: str
    run: Callable[[Scan, MaterialPrior, int, Progress], Object]
