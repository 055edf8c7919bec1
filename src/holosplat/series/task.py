"""One task of a series: a window of times in order, each reconstructed, or all tracked; finished times are skipped."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np

from ..bodies.rest_shape import moments
from ..checks import InputError, as_written, is_of_memory, reason_of, require
from ..inference import Decision
from ..io.atomic import read_json, write_json
from ..io.formats import read_frames, run_source
from ..io.lock import sole_writer
from ..io.reading import Reading
from ..metrics import ImageScores
from ..representations import InMotion, MovingSurfaces
from ..scan import Scan
from ..tables import read_rows
from ..units import number_of
from ..workflows.evaluate import TIMES, Evaluation, evaluate, write_times
from ..workflows.motion_choice import FEWEST, Motion, choose_motion, motion_named
from ..workflows.reconstruct import reconstruct
from ..workflows.reconstruction import Reconstruction
from ..workflows.run_folder import RunFolder, claimed
from ..workflows.track import reconstruct_moving, track
from .folder import DONE, FAILED, Row, SeriesFolder, TaskState, read_row, write_row
from .one_time import (
    CONSERVED,
    PHASE,
    Before,
    Shot,
    Told,
    bodies_of,
    common_totals,
    is_conserved,
    is_spherical,
    is_worse,
    reconstruct_time,
    retry_time,
    told_of,
    write_phase,
)
from .plan import Moment, SeriesPlan, Source, Window, fingerprint

MOTION = "motion.json"
"""What was decided of how the matter of a task changes."""
Result = TypeVar("Result")
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
        said, reason = attempted(_Work(folder, plan, window, on_row).run)
        reason = reason or said
        if reason:
            write_json(path / FAILED, {"reason": reason})
        else:
            write_json(path / DONE, {"times": len(window.moments), "seconds": round(time.perf_counter() - began, 3)})
    return folder.state(window)


@dataclass
class _Work:
    """The rest of a task. on_row: called with every row that is written."""

    folder: SeriesFolder
    plan: SeriesPlan
    window: Window
    on_row: OnRow
    _open: tuple[int, Scan] | None = None

    def run(self) -> str:
        """Do the times; why not all of them could be, or nothing."""
        motion, line = self._motion()
        if motion != "each":
            source, run = self._source(self.window.moments[0]), RunFolder(self.folder.whole(self.window.number))
            rows = [replace(_blank(moment, source), decided=line) for moment in self.window.moments]
            for row in window_of_one_run(self._scan(self.window.moments[0]), source, self.plan, rows, run, motion):
                self._write(row)
            return ""
        warm, failed, before = self.plan.settings.warm.on, list[Row](), None
        for number, moment in enumerate(self.window.moments):
            path, run = self._place(moment)
            old = row = read_row(path) if path.is_file() else None
            if row is None or not row.done:
                if old is not None:  # it failed, and began as what is before it was then
                    shutil.rmtree(run.path, ignore_errors=True)
                done, reason = attempted(partial(self._reconstructed, moment, run, before))
                row = done or replace(_blank(moment, self._source(moment)), reason=reason)
                if old is not None and row.done and warm:  # those after it were done without it
                    for later in self.window.moments[number + 1 :]:
                        path, run_after = self._place(later)
                        path.unlink(missing_ok=True)
                        shutil.rmtree(run_after.path, ignore_errors=True)
                self._write(row)
            if row.done:
                before = Before(run, row)
            else:
                failed.append(row)
        if not failed:
            again = (self._back, self._conserved) if warm else ()
            return "; ".join(filter(None, (each() for each in again)))
        return f"{len(failed)} of {len(self.window.moments)} times: {failed[0].reason}"

    def _motion(self) -> tuple[Motion, str]:
        """How the matter of the window changes, and the decision on that in words, which is made once; of few times,
        each is taken by itself."""
        settings, noted = self.plan.settings, self.folder.task(self.window.number) / MOTION
        if settings.act != "auto":
            return motion_named(settings.asked), ""
        if len(self.window.moments) < FEWEST:
            return "each", ""
        if noted.is_file():
            with as_written(noted):
                decision = Decision.from_dict(read_json(noted))
        else:
            moments, source = self.window.moments, self._source(self.window.moments[0])
            part = _part(self._scan(moments[0]), moments[0].frame, moments[-1].frame)
            asked = {"light": settings.light, "matter": settings.matter, "bodies": settings.motion}
            decision = choose_motion(part, source.prior, settings.method, settings.seed, **asked)
            write_json(noted, decision.as_dict())
        return motion_named(decision.choice), decision.line

    def _back(self) -> str:
        """Go back over the finished times once, and try those again that are worse than the time after them
        (`is_worse`); why not all of them could be, or nothing."""
        failed, after = list[str](), None
        for moment in reversed(self.window.moments):
            own, shot = self._own(moment), self._shot(moment)
            if after is not None:
                row, reason = attempted(partial(self._tried_again, shot, own, *after))
                failed += [reason] if reason else []
                if row is not None:
                    self._write(row)
                    own = replace(own, row=row)
            after = own, shot.scan
        return f"{number_of(len(failed), 'time')} could not be tried again: {failed[0]}" if failed else ""

    def _conserved(self) -> str:
        """Try times of spherical matter again with the total δ that the others tell, where it may be conserved
        (`common_totals`); why not all of them could be, or nothing."""
        every = {moment.number: (moment, self._own(moment)) for moment in self.window.moments}
        if not all(is_spherical(own) for _, own in every.values()):
            return ""
        noted, failed = self.folder.task(self.window.number) / CONSERVED, list[str]()
        if not noted.is_file():
            totals = common_totals([own.row for _, own in every.values()])
            write_json(noted, {str(number): told for number, told in totals.items()})
        for number, told in read_json(noted).items():
            moment, own = every[int(number)]
            if is_conserved(own):
                continue
            row, reason = attempted(partial(self._with_total, moment, own, tuple(told)))
            failed += [reason] if reason else []
            if row is not None:
                self._write(row)
        some = number_of(len(failed), "time")
        return f"{some} could not be tried with the total of the others: {failed[0]}" if failed else ""

    def _reconstructed(self, moment: Moment, run: RunFolder, before: Before | None) -> Row:
        return reconstruct_time(self._shot(moment), self.plan.settings, run, before)

    def _tried_again(self, shot: Shot, own: Before, after: Before, later: Scan) -> Row | None:
        return retry_time(shot, self.plan.settings, own, after) if is_worse(shot, own, after, later) else None

    def _with_total(self, moment: Moment, own: Before, told: Told) -> Row:
        return retry_time(self._shot(moment), self.plan.settings, own, own, told)

    def _write(self, row: Row) -> None:
        write_row(self.folder.row(self.window.number, row.number), row)
        self.on_row(row)

    def _place(self, moment: Moment) -> tuple[Path, RunFolder]:
        """The file of a time's row, and the folder of its run."""
        where = self.window.number, moment.number
        return self.folder.row(*where), RunFolder(self.folder.run(*where))

    def _own(self, moment: Moment) -> Before:
        path, run = self._place(moment)
        return Before(run, read_row(path))

    def _source(self, moment: Moment) -> Source:
        return self.plan.sources[moment.source]

    def _shot(self, moment: Moment) -> Shot:
        source = self._source(moment)
        return Shot.of(self._scan(moment), source.path, source.prior, self.plan.reading, _blank(moment, source))

    def _scan(self, moment: Moment) -> Scan:
        """The whole scan of a time, whose frames are not read yet; one is kept open. Errors: `InputError` where it is
        not what was planned with."""
        if self._open is None or self._open[0] != moment.source:
            self._open = moment.source, opened(self._source(moment), self.plan.reading)
        return self._open[1]


def _blank(moment: Moment, source: Source) -> Row:
    return Row(moment.number, str(source.path), moment.frame, moment.time, "failed")


def attempted(work: Callable[[], Result]) -> tuple[Result | None, str]:
    """What `work` gives, and "", or None and why it failed: one fault must not take the others' results."""
    try:
        return work(), ""
    except Exception as error:
        if is_of_memory(error) and not isinstance(error, InputError):
            reason = "the memory of this machine is not enough; take larger pixels (--bin), fewer rows or fewer jobs"
            return None, reason
        return None, reason_of(error)


def opened(source: Source, reading: Reading) -> Scan:
    """The scan of a source; `InputError` if it is no longer what was planned with."""
    require(Path(source.path).exists(), f"{source.path} must be a scan of the series, but it is gone; bring it back.")
    scan = read_frames(source.path, reading)
    require(
        fingerprint(scan) == source.fingerprint,
        f"{source.path} must be as it was when the series was planned, but its frames differ; plan anew.",
    )
    return scan


def _part(scan: Scan, first: int, last: int) -> Scan:
    """The frames of some times of a scan, in memory."""
    return scan[np.flatnonzero(np.isin(scan.exposures.time, scan.instants[first : last + 1]))].in_memory()


def window_of_one_run(
    scan: Scan, source: Source, plan: SeriesPlan, rows: Sequence[Row], folder: RunFolder, motion: Motion
) -> list[Row]:
    """Find what all times of `rows` have together, and fill these in; an unfinished run is continued. Where nothing
    flows, matter is taken to be still.

    Errors: `InputError` of `track`, `reconstruct_moving` and `reconstruct`. Ctrl-C is passed on.
    """
    began, settings = time.perf_counter(), plan.settings
    first, last = rows[0].frame, rows[-1].frame
    part, prior, seed = _part(scan, first, last), source.prior, settings.seed
    told = {"light": settings.light, "folder": folder, "resume": True}
    moving = reconstruct_moving(part, prior, seed=seed, **told) if motion == "flow" else None
    if motion == "bodies":
        done = track(part, prior, settings.motion, seed, **told)
    elif moving is not None:
        done = moving.reconstruction
    else:
        done = reconstruct(part.as_static(), prior, settings.method, seed, matter=settings.matter, **told)
    if not done.finished:
        raise KeyboardInterrupt
    how = {"time_frames": f"{first}:{last + 1}", "time_frame": "still" if motion != "bodies" and not moving else None}
    reading = replace(plan.reading, part=replace(plan.reading.part, **how))
    with claimed(folder):
        folder.write_source(run_source(source.path, reading))
        evaluation = evaluate(done, part, None)
        write_times(folder.path / TIMES, done, part, evaluation.light)
        judged = read_rows(folder.path / TIMES, "what a task wrote")
        filled = [_filled(row, done, part, evaluation, folder, said) for row, said in zip(rows, judged)]
        if settings.reports:
            from ..report.run import report_run  # which needs matplotlib

            report_run(folder, done, part, evaluation, None)
    seconds = round((time.perf_counter() - began) / len(rows), 3)
    return [replace(row, seconds=seconds) for row in filled]


def _filled(
    row: Row, done: Reconstruction, part: Scan, evaluation: Evaluation, folder: RunFolder, said: Mapping[str, str]
) -> Row:
    """`row` with what the run of all times says of its own; said: its row of times.csv."""
    found, when = done.object, part.exposures.time
    now = found.at(row.time_s) if isinstance(found, InMotion) else found
    scores = {
        "test": _means(evaluation.test, when[part.is_test] == row.time_s),
        "train": _means(evaluation.train, when[~part.is_test] == row.time_s),
    }
    write_phase(folder.path / f"t{row.number:04d}.{PHASE}", now, part[np.flatnonzero(when == row.time_s)])
    if isinstance(found, MovingSurfaces):
        measured = [moments(mesh)[:2] for mesh in found.bodies(row.time_s)]
        bodies = tuple((*(float(x) for x in centre), float(volume)) for volume, centre in measured)
        told = {"quantity": "δ", "total": float(sum(volume for volume, _ in measured)) * found.matter.delta}
    else:
        bodies, told = bodies_of(now), {} if done.total is None else told_of(done.total)
    row = replace(row, status="done", begun="cold", kind=found.kind, size=found.described, bodies=bodies)
    return replace(row, good=said["explained"] == "1", words=said["verdict"], **told, **scores)


def _means(scores: ImageScores | None, chosen: np.ndarray) -> dict[str, float]:
    """Means over the frames of one time."""
    if scores is None or not chosen.any():
        return {}
    return {name: float(np.mean(getattr(scores, name)[chosen])) for name in ("ssim", "frcm", "psnr", "l1")}
