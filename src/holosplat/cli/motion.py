"""`holosplat reconstruct --motion flow`: matter in motion, where the frames say that something moves."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..io.formats import read_frames
from ..io.reading import Reading
from ..io.run_scan import run_source
from ..matter import KnownSeveral, MaterialPrior, MatterKind
from ..methods import Auto, Method
from ..motion.flow_reconstruction import FlowOptions
from ..optics.background import LightOptions
from ..planning.acts import of_motion
from ..report.run import report_run
from ..scan import Scan
from ..workflows.evaluate import evaluate as score
from ..workflows.reconstruction import Reconstruction, reconstruction_at
from ..workflows.run_folder import RunFolder
from ..workflows.track import begun_in_motion, reconstruct_moving
from .progress import INTERRUPTED, ProgressBar
from .room import tell_frames

FEWEST_TIMES = 3
"""Times from which on matter in motion can be found."""


def asks_for_motion(reading: Reading, method: Method, matter: MatterKind | None, plain: bool) -> bool:
    """Whether --motion flow is to find motion: where the method is left to the program, matter is not said to have
    levels, and nothing else is asked for (`plain`)."""
    return reading.part.time_frame == "all" and isinstance(method, Auto) and matter != "levels" and plain


def may_go_on(folder: RunFolder, resume: bool) -> bool:
    """Whether a run in motion may be in `folder`, or begin there; not where one of another kind is to go on."""
    return not resume or not folder.config.is_file() or begun_in_motion(folder)


def reconstruct_in_motion(
    scan: Path,
    reading: Reading,
    prior: MaterialPrior,
    folder: RunFolder,
    how: tuple[int, LightOptions, FlowOptions],
    *,
    resume: bool = False,
) -> bool:
    """Find matter in motion, write its run, its report and its scores; False where nothing moves, or times are few.

    how: the seed, what is assumed of the light, and how matter moves.
    """
    seed, light, options = how
    reading = replace(reading, part=replace(reading.part, time_frame=None))
    planned = read_frames(scan, replace(reading, told=reading.told.at_middle()))
    train = planned.exposures[~planned.is_test]
    count = len(np.unique(train.time))
    if isinstance(prior, KnownSeveral):
        return _still("a flow carries one material, but several are known, and motion is not asked of the frames")
    if count < FEWEST_TIMES:
        return _still(f"motion is asked of frames of {FEWEST_TIMES} times or more, but there are {count}")
    tell_frames("matter in motion", train, folder.path, lambda seen: of_motion(seen, options))
    measured = planned.in_memory()
    try:
        with ProgressBar() as bar:
            told = {"light": light, "folder": folder, "resume": resume, "on_progress": bar.show}
            found = reconstruct_moving(measured, prior, options, seed, **told)
    except KeyboardInterrupt:
        begun = folder.checkpoint.is_file()
        print(f"interrupted{f'; go on with --out {folder.path} --resume' if begun else ''}", file=sys.stderr)
        raise SystemExit(INTERRUPTED) from None
    if found is None:
        return _still("nothing moves, as far as the frames tell")
    result = found.reconstruction
    folder.write_source(run_source(scan, reading))
    evaluation, report = score(result, measured, None), report_of_middle(folder, result, measured)
    for line in (*evaluation.lines(), *(result.verdict.lines("training frames") if result.verdict else ())):
        print(line)
    seconds = sum(result.timing.values())
    for line in (*found.history, *(each.line for each in result.choice.decisions)):
        print(line, file=sys.stderr)
    print(f"{seconds:.1f} s, {result.object.described}; report: {report}", file=sys.stderr)
    return True


def _still(why: str) -> bool:
    print(f"{why}: they are taken as of one time", file=sys.stderr)
    return False


def report_of_middle(folder: RunFolder, result: Reconstruction, measured: Scan) -> Path:
    """The report of a run of several times at the one in the middle."""
    times = measured.train().instants.tolist()
    middle = len(times) // 2
    shown = measured[(measured.exposures.time == times[middle]).nonzero()[0]].as_static()
    now = reconstruction_at(result, times, middle)
    whole = f"This is the time {1e6 * times[middle]:.4g} µs, of {len(measured)} frames of {len(times)} times in all."
    return report_run(folder, now, shown, score(now, shown, None), None, whole)
