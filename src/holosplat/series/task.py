"""One task of a series: a window of times in order, each reconstructed, or all tracked; finished times are skipped."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from ..bodies.rest_shape import moments
from ..checks import InputError, is_of_memory, require
from ..io.atomic import read_json, write_json
from ..io.formats import read_frames, run_source
from ..io.lock import sole_writer
from ..io.reading import Reading
from ..metrics import ImageScores
from ..representations import MovingSurfaces
from ..scan import Scan
from ..workflows.evaluate import Evaluation, evaluate
from ..workflows.reconstruction import Reconstruction
from ..workflows.run_folder import RunFolder, claimed
from ..workflows.track import track
from .folder import DONE, FAILED, Row, SeriesFolder, TaskState, read_row, write_row
from .one_time import (
    CONSERVED,
    PHASE,
    Before,
    Shot,
    Told,
    common_totals,
    is_conserved,
    is_spherical,
    is_worse,
    reconstruct_time,
    retry_time,
    write_phase,
)
from .plan import Moment, SeriesPlan, Settings, Source, Window, at, fingerprint

OnRow = Callable[[Row], None]
"""Called with every row that is written."""


def nothing(row: Row) -> None:
    """Nobody wants to know."""


def run_task(folder: SeriesFolder, number: int, on_row: OnRow = nothing) -> TaskState:
    """Do the rest of a task, and return its progress.

    Every time has its run folder and its row, written whole: after a kill, the task goes on in the middle of the time
    that was lost, with the same result bit for bit. What fails is said in `failed.json`, and done again by the next
    call. Ctrl-C is passed on. Errors: `InputError` for an unknown task, and `TakenError` where another process
    does it.
    """
    plan = folder.plan()
    windows = plan.windows()
    require(0 <= number < len(windows), f"tasks are counted from 0 to {len(windows) - 1}, but {number} is asked for.")
    window, path = windows[number], folder.task(number)
    path.parent.mkdir(exist_ok=True)
    with sole_writer(path):
        if (path / DONE).is_file():
            return folder.state(window)
        (path / FAILED).unlink(missing_ok=True)
        began = time.perf_counter()
        reason = attempted(lambda: _work(folder, plan, window, on_row))
        if reason:
            write_json(path / FAILED, {"reason": reason})
        else:
            write_json(path / DONE, {"times": len(window.moments), "seconds": round(time.perf_counter() - began, 3)})
    return folder.state(window)


def _work(folder: SeriesFolder, plan: SeriesPlan, window: Window, on_row: OnRow) -> str:
    """Do the times; why not all of them could be, or nothing."""
    scans = Scans(plan)
    if plan.settings.act == "track":
        run = RunFolder(folder.task(window.number) / "run")
        moment = window.moments[0]
        source = plan.sources[moment.source]
        rows = [_blank(m, source) for m in window.moments]
        for row in track_window(scans.of(moment), source, plan, rows, run):
            write_row(folder.row(window.number, row.number), row)
            on_row(row)
        return ""
    failed, before = list[Row](), None
    for number, moment in enumerate(window.moments):
        path, run = folder.row(window.number, moment.number), RunFolder(folder.run(window.number, moment.number))
        old = row = read_row(path) if path.is_file() else None
        if row is None or not row.done:
            if old is not None:  # it failed, and began as what is before it was then
                shutil.rmtree(run.path, ignore_errors=True)
            row = _row(plan, moment, scans, run, before)
            if old is not None and row.done and plan.settings.warm.on:
                _remove(folder, window.number, window.moments[number + 1 :])
            write_row(path, row)
            on_row(row)
        if row.done:
            before = Before(run, row)
        else:
            failed.append(row)
    if not failed:
        again = (_back, _conserved) if plan.settings.warm.on else ()
        return "; ".join(filter(None, (each(folder, plan, window, scans, on_row) for each in again)))
    return f"{len(failed)} of {len(window.moments)} times: {failed[0].reason}"


def _back(folder: SeriesFolder, plan: SeriesPlan, window: Window, scans: Scans, on_row: OnRow) -> str:
    """Go back over the finished times once, and try those again that are worse than the time after them (`is_worse`);
    why not all of them could be, or nothing."""
    failed, after = list[str](), list[tuple[Before, Scan]]()
    for moment in reversed(window.moments):
        path, shot = folder.row(window.number, moment.number), _shot(plan, moment, scans)
        own = Before(RunFolder(folder.run(window.number, moment.number)), read_row(path))
        found = list[Row]()
        work = partial(_tried_again, shot, plan.settings, own, after, found)
        failed += [reason] if (reason := attempted(work)) else []
        for row in found:
            write_row(path, row)
            on_row(row)
            own = replace(own, row=row)
        after = [(own, shot.scan)]
    return f"{len(failed)} times could not be tried again: {failed[0]}" if failed else ""


def _conserved(folder: SeriesFolder, plan: SeriesPlan, window: Window, scans: Scans, on_row: OnRow) -> str:
    """Try times of spherical matter again with the total δ that the others tell, where it may be conserved
    (`common_totals`); why not all of them could be, or nothing."""
    every = [
        (moment, Before(RunFolder(folder.run(window.number, moment.number)), read_row(path)))
        for moment in window.moments
        if (path := folder.row(window.number, moment.number))
    ]
    if not all(is_spherical(own) for _, own in every):
        return ""
    noted, failed = folder.task(window.number) / CONSERVED, list[str]()
    if not noted.is_file():
        write_json(noted, {str(number): told for number, told in common_totals([own.row for _, own in every]).items()})
    for number, told in read_json(noted).items():
        moment, own = next(each for each in every if each[0].number == int(number))
        if is_conserved(own):
            continue

        def work(moment: Moment = moment, own: Before = own, told: Told = tuple(told)) -> str:
            row = retry_time(_shot(plan, moment, scans), plan.settings, own, own, told)
            write_row(folder.row(window.number, moment.number), row)
            on_row(row)
            return ""

        failed += [reason] if (reason := attempted(work)) else []
    return f"{len(failed)} times could not be tried with the total of the others: {failed[0]}" if failed else ""


def _tried_again(
    shot: Shot, settings: Settings, own: Before, after: Sequence[tuple[Before, Scan]], found: list[Row]
) -> str:
    """Add the new row of a time that is tried again from the one `after` it, of its scan, to those `found`."""
    found += [retry_time(shot, settings, own, later) for later, scan in after if is_worse(shot, own, later, scan)]
    return ""


def _remove(folder: SeriesFolder, task: int, moments: Sequence[Moment]) -> None:
    """Remove times that were done without the one before them, which failed then: they are as if it never had."""
    for moment in moments:
        folder.row(task, moment.number).unlink(missing_ok=True)
        shutil.rmtree(folder.run(task, moment.number), ignore_errors=True)


def _row(plan: SeriesPlan, moment: Moment, scans: Scans, run: RunFolder, before: Before | None) -> Row:
    row = _blank(moment, plan.sources[moment.source])

    def work() -> str:
        nonlocal row
        row = reconstruct_time(_shot(plan, moment, scans), plan.settings, run, before)
        return ""

    reason = attempted(work)
    return replace(row, status="failed", reason=reason) if reason else row


def _shot(plan: SeriesPlan, moment: Moment, scans: Scans) -> Shot:
    source = plan.sources[moment.source]
    frame = moment.frame if len(source.times) > 1 else None
    reading = replace(plan.reading, part=replace(plan.reading.part, time_frame=frame))
    scan = at(scans.of(moment), moment.frame)
    return Shot(scan, source.prior, run_source(source.path, reading), _blank(moment, source))


def _blank(moment: Moment, source: Source) -> Row:
    return Row(moment.number, str(source.path), moment.frame, moment.time, "failed")


def attempted(work: Callable[[], str]) -> str:
    """What `work` says, or why it failed: one fault must not take the others' results."""
    try:
        return work()
    except InputError as error:
        return str(error)
    except Exception as error:
        if is_of_memory(error):
            return "the memory of this machine is not enough; take larger pixels (--bin), fewer rows or fewer jobs"
        lines = str(error).strip().splitlines()
        return ": ".join([type(error).__name__, *lines[-1:]])


class Scans:
    """The scans of a plan, each opened when it is first asked for, and held against the plan then; one is kept."""

    def __init__(self, plan: SeriesPlan) -> None:
        self._plan, self._kept = plan, dict[int, Scan]()

    def of(self, moment: Moment) -> Scan:
        """The whole scan of a time, whose frames are not read yet. Errors: `InputError` where it is not what it was."""
        number = moment.source
        if number not in self._kept:
            source = self._plan.sources[number]
            self._kept = {number: opened(source, self._plan.reading)}
        return self._kept[number]


def opened(source: Source, reading: Reading) -> Scan:
    """The scan of a source; `InputError` if it is no longer what was planned with."""
    require(Path(source.path).exists(), f"{source.path} must be a scan of the series, but it is gone; bring it back.")
    scan = read_frames(source.path, reading)
    require(
        fingerprint(scan) == source.fingerprint,
        f"{source.path} must be as it was when the series was planned, but its frames differ; plan anew.",
    )
    return scan


def track_window(scan: Scan, source: Source, plan: SeriesPlan, rows: Sequence[Row], folder: RunFolder) -> list[Row]:
    """Follow the bodies through the times of `rows`, and fill these in; an unfinished run is continued.

    Errors: `InputError` of `track`. Ctrl-C is passed on.
    """
    began, settings = time.perf_counter(), plan.settings
    first, last = rows[0].frame, rows[-1].frame
    part = scan[np.flatnonzero(np.isin(scan.exposures.time, scan.instants[first : last + 1]))].in_memory()
    done = track(part, source.prior, settings.motion, settings.seed, light=settings.light, folder=folder, resume=True)
    reading = replace(plan.reading, part=replace(plan.reading.part, time_frames=f"{first}:{last + 1}"))
    with claimed(folder):
        folder.write_source(run_source(source.path, reading))
        evaluation = evaluate(done, part, None)
        filled = [_filled(row, done, part, evaluation, folder) for row in rows]
        if settings.reports:
            from ..report.run import report_run  # which needs matplotlib

            report_run(folder, done, part, evaluation, None)
    seconds = round((time.perf_counter() - began) / len(rows), 3)
    return [replace(row, seconds=seconds) for row in filled]


def _filled(row: Row, done: Reconstruction, part: Scan, evaluation: Evaluation, folder: RunFolder) -> Row:
    assert isinstance(done.object, MovingSurfaces)
    when, verdict = part.exposures.time, done.verdict
    now = done.object.at(row.time_s)
    meshes = done.object.bodies(row.time_s)
    measured = [moments(mesh)[:2] for mesh in meshes]
    scores = {
        "test": _means(evaluation.test, when[part.is_test] == row.time_s),
        "train": _means(evaluation.train, when[~part.is_test] == row.time_s),
    }
    said = {} if verdict is None else {"good": verdict.good, "words": verdict.words}
    held = float(sum(volume for volume, _ in measured)) * done.object.matter.delta
    write_phase(folder.path / f"t{row.number:04d}.{PHASE}", now, part[np.flatnonzero(when == row.time_s)])
    return replace(
        row,
        status="done",
        begun="cold",
        kind=done.object.kind,
        size=done.object.described,
        bodies=tuple((*(float(x) for x in centre), float(volume)) for volume, centre in measured),
        quantity="δ",
        total=held,
        **scores,
        **said,
    )


def _means(scores: ImageScores | None, chosen: np.ndarray) -> dict[str, float]:
    """Means over the frames of one time."""
    if scores is None or not chosen.any():
        return {}
    return {name: float(np.mean(getattr(scores, name)[chosen])) for name in ("ssim", "frcm", "psnr", "l1")}
