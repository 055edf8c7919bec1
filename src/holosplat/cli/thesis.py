"""`holosplat bench thesis`: the thesis' study, rerun and reported."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from ..ranges import Seed
from .progress import INTERRUPTED, ProgressBar

if TYPE_CHECKING:
    from ..thesis.study import StudyFolder

CASE = "thesis16"


def thesis(
    out: Path = Path("thesis_study"),
    schedule: Literal["full", "short"] = "short",
    configurations: tuple[str, ...] = (),
    snapshots: Path | None = None,
    seed: Seed = 0,
) -> None:
    """Rerun the thesis' study: its eight configurations, its schedule and loss, and all curves.

    What is finished is kept, so the same command goes on where an earlier one ended.

    Args:
        out: Folder of the study, new or to go on with.
        schedule: The thesis' 30 000 steps, or one ten times shorter.
        configurations: Names of configurations (default: the thesis' eight).
        snapshots: Folder of simulated cells (VTK files), of which the seed takes one; without, cells are generated.
        seed: Seed of the scene and of the random start.
    """
    from ..bench.case import load_case
    from ..io.lock import sole_writer
    from ..thesis.study import PACES, Measured, StudyFolder, run_study
    from ..thesis.study import configurations as named

    chosen, folder, interrupted = named(configurations), StudyFolder(out), False
    try:
        with sole_writer(out), ProgressBar() as bar:
            bar.show("scene and scan", 0.0, {})
            measured = Measured.of(load_case(CASE, seed, snapshots))
            run_study(measured, chosen, PACES[schedule], seed, folder, bar.show)
    except KeyboardInterrupt:
        interrupted = True
    if not interrupted or any(folder.finished(configuration.name) for configuration in chosen):
        _report(folder)
    if interrupted:
        _say(f"interrupted; finished configurations stay in {out}, and the same command goes on behind them")
        raise SystemExit(INTERRUPTED)


def _report(folder: StudyFolder) -> None:
    from ..thesis.pages import write_study
    from ..thesis.study import load_study

    for path in write_study(load_study(folder), folder.path):
        _say(f"wrote {path}")


def _say(text: str) -> None:
    print(text, file=sys.stderr)
