"""One task of a series: a window of times in order, each reconstructed, or all tracked; finished times are skipped."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from ..bodies.rest_shape import moments
from ..checks import InputError, is_of_memory, require
from ..io.atomic import atomic_path
from ..io.formats import read_frames, run_source
from ..io.json import write_json
from ..io.lock import sole_writer
from ..io.reading import Reading
from ..matter import MaterialPrior
from ..methods import Method
from ..methods.continued import Continued
from ..metrics import ImageScores
from ..progress import FitProgress
from ..representations import MovingSurfaces, Stored, SurfaceMesh
from ..scan import Scan
from ..units import wavenumber
from ..workflows.evaluate import Evaluation, evaluate
from ..workflows.reconstruct import reconstruct
from ..workflows.reconstruction import Reconstruction
from ..workflows.run_folder import RunFolder, claimed
from ..workflows.track import track
from .folder import DONE, FAILED, Begun, Body, Row, SeriesFolder, TaskState, read_row, write_row
from .plan import Moment, SeriesPlan, Settings, Source, Window, at, fingerprint

PHASE = "phase.npy"
"""The phase in the first view [rad], for pages."""
MOST_PIXELS = 160
"""Pixels along the longer edge of that, at most: it is binned until it has no more."""


@dataclass(frozen=True)
class Shot:
    """The frames of one time. scan: of that time alone; source: what source.json says of them; row: with the number and
    the place of the time, which the result fills in."""

    scan: Scan
    prior: MaterialPrior
    source: dict[str, object]
    row: Row


@dataclass(frozen=True)
class Before:
    """The time before: the folder of its run and its row."""

    folder: RunFolder
    row: Row


def quiet(stage: str, fraction: float, record: dict[str, float]) -> None:
    """Progress that nobody looks at."""


def reconstruct_time(
    shot: Shot, settings: Settings, folder: RunFolder, before: Before | None = None, on_progress: FitProgress = quiet
) -> Row:
    """Reconstruct one time into `folder`, and say what came of it; an unfinished run is continued.

    A time that goes on from the one before begins anew, by itself, if its frames are not explained and leave clearly
    more matter unexplained than the last time that began by itself. Ctrl-C is passed on. Errors: `InputError` of
    `reconstruct`.
    """
    began = time.perf_counter()
    alone: Begun = "cold"
    if before is not None and settings.warm.on and _same_field(before, shot.scan):
        method = Continued.of(settings.method, before.folder.object.resolve(), settings.warm.effort)
        alone = "anew"
        if not _begun_alone(folder, method):
            done = _run(shot, settings, method, folder, on_progress, before)
            allowed = settings.warm.worse * (before.row.reference or 0.0)
            if _explained(done) or _share(done) <= allowed:
                row = replace(shot.row, begun="warm", reference=before.row.reference)
                return _written(shot, settings, folder, done, row, began)
            shutil.rmtree(folder.path)
    done = _run(shot, settings, settings.method, folder, on_progress)
    return _written(shot, settings, folder, done, replace(shot.row, begun=alone, reference=_share(done)), began)


def _same_field(before: Before, scan: Scan) -> bool:
    """Whether the time before was seen by the same pixels, at the same energy."""
    summary, views = before.folder.read_summary(), scan.views
    seen = summary["detector"]
    alike = (seen["rows"], seen["columns"]) == views.shape
    sizes = (seen["pixel_size_m"], views.finest), (summary["energy_kev"], scan.exposures.reference_energy)
    return alike and all(abs(a / b - 1) < 1e-6 for a, b in sizes)


def _begun_alone(folder: RunFolder, method: Continued) -> bool:
    """Whether a run that is there began by itself. One that was continued from another file, as before its folder was
    moved, is removed: it is done again with the same numbers."""
    if not folder.config.is_file():
        return False
    was = folder.read_config().get("method", {})
    if was.get("kind") != Continued.kind:
        return True
    if was.get("begin") != str(method.begin):
        shutil.rmtree(folder.path)
    return False


def _run(
    shot: Shot,
    settings: Settings,
    method: Method,
    folder: RunFolder,
    on_progress: FitProgress,
    before: Before | None = None,
) -> Reconstruction:
    matter = settings.matter
    if before is not None:  # it was decided there
        found = before.folder.read_summary().get("decided", {}).get("matter")
        matter = "continuous" if found == "continuous" else "levels"
    done = reconstruct(
        shot.scan,
        shot.prior,
        method,
        settings.seed,
        matter=matter,
        light=settings.light,
        folder=folder,
        resume=True,
        on_progress=on_progress,
    )
    if not done.finished:
        raise KeyboardInterrupt
    return done


def _explained(done: Reconstruction) -> bool:
    return done.verdict is None or done.verdict.good


def _share(done: Reconstruction) -> float:
    """Share of the matter that the result leaves unexplained in its frames."""
    return float(done.choice.judged.get(done.choice.kept, 0.0))


def _written(shot: Shot, settings: Settings, folder: RunFolder, done: Reconstruction, row: Row, began: float) -> Row:
    with claimed(folder):
        folder.write_source(shot.source)
        scan = done.placed(shot.scan)
        evaluation = evaluate(done, scan, None)
        write_phase(folder.path / PHASE, done.object, scan)
        if settings.reports:
            from ..report.run import report_run  # which needs matplotlib

            report_run(folder, done, scan, evaluation, None)
        for path in (folder.checkpoint, folder.earlier_checkpoint):  # of no use any more, and larger than the object
            path.unlink(missing_ok=True)
    return replace(filled(row, done, evaluation), seconds=round(time.perf_counter() - began, 3))


def filled(row: Row, done: Reconstruction, evaluation: Evaluation) -> Row:
    """`row` with what a finished reconstruction says."""
    scores = {"test": evaluation.test, "train": evaluation.train}
    means = {name: {} if one is None else one.as_dict()["mean"] for name, one in scores.items()}
    total = done.total
    told = {} if total is None else {"quantity": total.quantity, "total": total.value, "total_error": total.error}
    verdict = done.verdict
    said = {} if verdict is None else {"good": verdict.good, "words": verdict.words}
    bodies = bodies_of(done.object)
    found = {"kind": done.object.kind, "size": done.object.described, "unexplained": _share(done), "bodies": bodies}
    return replace(row, status="done", **found, **means, **told, **said)


def bodies_of(found: Stored) -> tuple[Body, ...]:
    """Centre x, y, z [m] and volume [m³] of each closed body, the largest first; none of an object without."""
    if not isinstance(found, SurfaceMesh):
        return ()
    try:
        meshes = found.bodies()
    except InputError:  # no surface encloses matter
        return ()
    parts = [moments(mesh)[:2] for mesh in meshes]
    return tuple((*(float(x) for x in centre), float(volume)) for volume, centre in parts)  # type: ignore[misc]


def write_phase(path: Path, found: Stored, scan: Scan) -> None:
    """Write the phase -k ∫δ [H, W] [rad] in the first view, float16, binned to `MOST_PIXELS`."""
    views = scan.views[[0]]
    with torch.no_grad():
        _, lines = found.project(views)
        delta = lines[0].cpu().numpy()
    factor = -(-max(views.shape) // MOST_PIXELS)
    h, w = (n // factor * factor for n in views.shape)
    binned = delta[:h, :w].reshape(h // factor, factor, w // factor, factor).mean((1, 3))
    with atomic_path(path) as temporary:
        np.save(
            temporary, (-wavenumber(scan.exposures.reference_energy) * binned).astype(np.float16), allow_pickle=False
        )


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
        return ""
    return f"{len(failed)} of {len(window.moments)} times: {failed[0].reason}"


def _remove(folder: SeriesFolder, task: int, moments: Sequence[Moment]) -> None:
    """Remove times that were done without the one before them, which failed then: they are as if it never had."""
    for moment in moments:
        folder.row(task, moment.number).unlink(missing_ok=True)
        shutil.rmtree(folder.run(task, moment.number), ignore_errors=True)


def _row(plan: SeriesPlan, moment: Moment, scans: Scans, run: RunFolder, before: Before | None) -> Row:
    source = plan.sources[moment.source]
    row = _blank(moment, source)

    def work() -> str:
        nonlocal row
        scan = at(scans.of(moment), moment.frame)
        frame = moment.frame if len(source.times) > 1 else None
        reading = replace(plan.reading, part=replace(plan.reading.part, time_frame=frame))
        shot = Shot(scan, source.prior, run_source(source.path, reading), row)
        row = reconstruct_time(shot, plan.settings, run, before)
        return ""

    reason = attempted(work)
    return replace(row, status="failed", reason=reason) if reason else row


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
