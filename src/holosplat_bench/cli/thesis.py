"""`holosplat bench thesis`: the thesis' study, rerun and reported."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from holosplat.cli.places import Kept
from holosplat.cli.progress import INTERRUPTED, ProgressBar
from holosplat.ranges import Seed

if TYPE_CHECKING:
    from ..thesis.folder import StudyFolder


def thesis(
    out: Kept = Path("thesis_study"),
    schedule: Literal["full", "third", "short"] = "short",
    configurations: tuple[str, ...] = (),
    case: Literal["thesis16", "thesis8"] = "thesis16",
    physics: Literal["declared", "contact", "far", "blurred", "noisy"] = "declared",
    snapshots: Path | None = None,
    seed: Seed = 0,
) -> None:
    """Rerun the thesis' study: its configurations, its schedule and loss, and all curves.

    The same command goes on where an earlier one ended, or was interrupted.

    Args:
        out: Folder of the study, new or to go on with.
        schedule: The thesis' 30 000 steps, or one three or ten times shorter.
        configurations: Names of configurations (default: the eight of its Table 2).
        case: Twelve training views of sixteen, or eight.
        physics: The case as declared, in contact (absorption alone), at 50 cm, with a blurred or with a noisy detector.
        snapshots: Folder of simulated cells (VTK files), of which the seed takes one; without, cells are generated.
        seed: Seed of the scene and of the random start.
    """
    from holosplat.io.lock import sole_writer

    from ..suite.case import load_case
    from ..thesis.configurations import PACES
    from ..thesis.configurations import configurations as named
    from ..thesis.folder import StudyFolder
    from ..thesis.measured import Measured
    from ..thesis.study import run_study

    chosen, folder, interrupted = named(configurations), StudyFolder(out), False
    try:
        with sole_writer(out), ProgressBar() as bar:
            bar.show("scene and scan", 0.0, {})
            measured = Measured.of(load_case(case, seed, snapshots), physics)
            run_study(measured, chosen, PACES[schedule], seed, folder, bar.show)
    except KeyboardInterrupt:
        interrupted = True
    if not interrupted or any(folder.finished(configuration.name) for configuration in chosen):
        _report(folder)
    if interrupted:
        _say(f"interrupted; what is done stays in {out}, and the same command goes on from there")
        raise SystemExit(INTERRUPTED)


def _report(folder: StudyFolder) -> None:
    from ..thesis.folder import load_study
    from ..thesis.pages.page import write_study

    for path in write_study(load_study(folder), folder.path):
        _say(f"wrote {path}")


def _say(text: str) -> None:
    print(text, file=sys.stderr)
