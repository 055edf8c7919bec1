"""All tasks of a series in one table, one list of bodies, and one page, with the missing ones named."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import linear_sum_assignment

from ..geometry import Grid
from ..io.atomic import write_rows
from ..io.objects import read_object
from ..tables import number_in
from ..workflows.motion_choice import begun_motion
from ..workflows.rehearsal import read_rehearsal
from ..workflows.run_folder import RunFolder
from ..workflows.totals import TotalMatter
from .events import EVENT_COLUMNS, PARTS, TRACK_COLUMNS, History, Parts
from .folder import Body, Row, SeriesFolder, TaskState, plain, time_left
from .fronts import FRONT_COLUMNS, Front, front_rows
from .one_time import PHASE, Before, is_without_bodies
from .plan import Moment, SeriesPlan

if TYPE_CHECKING:
    from .page import SeriesPage

COLUMNS = (
    *("number", "scan", "frame", "time_s", "task", "status", "begun", "kind", "explained", "unexplained"),
    *("test_ssim", "test_frcm", "train_ssim", "train_frcm", "total_m3", "total_error_m3", "bodies", "seconds"),
    *("rehearsed", "total_low_m3", "total_high_m3", "dice_at_least"),
    *("run", "reason", "decided", "verdict"),
)
BODY_COLUMNS = ("number", "time_s", "body", "x_m", "y_m", "z_m", "volume_m3")


@dataclass(frozen=True)
class Collected:
    """A series and its results so far. rows: of each time, None where it is missing; task: that it is of; runs: its
    run folder; agreement: mean distance [m] of bodies at times that two tasks have done, by the later task;
    without_bodies: numbers of the times of matter that has none."""

    plan: SeriesPlan
    states: tuple[TaskState, ...]
    moments: tuple[Moment, ...]
    rows: tuple[Row | None, ...]
    tasks: tuple[int, ...]
    runs: tuple[Path, ...]
    bodies: tuple[tuple[int, ...], ...]
    agreement: dict[int, float] = field(default_factory=dict)
    without_bodies: tuple[int, ...] = ()

    @property
    def no_events(self) -> str:
        """Why some times have no events; empty where all may have some."""
        some = f"{len(self.without_bodies)} of {len(self.moments)} times"
        why = "continuous matter on both sides of its medium, or spherical matter, has no bodies"
        return f"{some} have no events of bodies: {why}" if self.without_bodies else ""

    @property
    def missing(self) -> list[int]:
        """Numbers of the times that have no result."""
        return [m.number for m, row in zip(self.moments, self.rows) if row is None or not row.done]


def collected(folder: SeriesFolder) -> Collected:
    """What the tasks of a series have done so far; of a time that two have, the result of whose own it is."""
    plan = folder.plan()
    windows = plan.windows()
    found, early, task_of, run_of = dict[int, Row](), dict[int, dict[int, Row]](), dict[int, int](), dict[int, Path]()
    for window in windows:
        rows = {row.number: row for row in folder.rows(window)}
        early[window.number] = {m.number: rows[m.number] for m in window.moments[: window.early] if m.number in rows}
        for moment in window.own:
            task_of[moment.number] = window.number
            run_of[moment.number] = folder.run_of(window.number, moment.number)
            if moment.number in rows:
                found[moment.number] = rows[moment.number]
    moments = tuple(plan.moments())
    rows = tuple(found.get(m.number) for m in moments)
    names, agreement = _identities(moments, found, early, task_of)
    return Collected(
        plan,
        tuple(folder.state(window) for window in windows),
        moments,
        rows,
        tuple(task_of[m.number] for m in moments),
        tuple(run_of[m.number] for m in moments),
        tuple(names.get(m.number, ()) for m in moments),
        agreement,
    )


def _identities(
    moments: Sequence[Moment], rows: dict[int, Row], early: dict[int, dict[int, Row]], task_of: dict[int, int]
) -> tuple[dict[int, tuple[int, ...]], dict[int, float]]:
    """Identities of the bodies at each time, and how well tasks agree.

    A body keeps its name from one time to the next; a task that has times of the one before is joined at the last of
    these, where both show the same bodies.
    """
    names, agreement, count = dict[int, tuple[int, ...]](), dict[int, float](), 0
    known: tuple[Sequence[Body], tuple[int, ...]] = ((), ())
    for moment in moments:
        row = rows.get(moment.number)
        if row is None or not row.bodies:
            continue
        task, before = task_of[moment.number], early.get(task_of[moment.number], {})
        last = before.get(moment.number - 1)
        if last is not None and moment.number - 1 in names and task_of[moment.number - 1] != task:
            mine, count = same_bodies(rows[moment.number - 1].bodies, names[moment.number - 1], last.bodies, count)
            places = dict(zip(mine, (np.array(body[:3]) for body in last.bodies)))
            found = [
                float(np.linalg.norm(np.array(b[:3]) - places[n]))
                for b, n in zip(rows[moment.number - 1].bodies, names[moment.number - 1])
                if n in places
            ]
            agreement[task] = float(np.mean(found)) if found else float("nan")
            known = last.bodies, mine
        names[moment.number], count = same_bodies(*known, row.bodies, count)
        known = row.bodies, names[moment.number]
    return names, agreement


def same_bodies(
    before: Sequence[Body], names: tuple[int, ...], now: Sequence[Body], count: int
) -> tuple[tuple[int, ...], int]:
    """Names of the bodies `now`: those of the nearest `before`, one to one, within a radius; new ones go on from
    `count`, which is returned raised."""
    given = [-1] * len(now)
    if before and now:
        a, b = np.array(before), np.array(now)
        distance = np.linalg.norm(a[:, None, :3] - b[None, :, :3], axis=-1)
        reach = np.cbrt(0.75 / np.pi * np.maximum(a[:, 3], 0.0))[:, None]
        for i, j in zip(*linear_sum_assignment(np.minimum(distance / np.maximum(reach, 1e-30), 10.0))):
            if distance[i, j] <= reach[i, 0]:
                given[j] = names[i]
    for j, name in enumerate(given):
        if name < 0:
            given[j], count = count, count + 1
    return tuple(given), count


def collect(folder: SeriesFolder, fronts: bool = False) -> Collected:
    """Write series.csv, bodies.csv, events.csv, tracks.csv and series.html of what is done so far; fronts: also
    fronts.csv, a spherical front of each time."""
    from .page import write_page  # which needs matplotlib

    found = collected(folder)
    done = [(m, row, run) for m, row, run in zip(found.moments, found.rows, found.runs) if row is not None and row.done]
    whole = {moment.number for moment, row, run in done if is_without_bodies(Before(RunFolder(run), row))}
    found = replace(found, without_bodies=tuple(sorted(whole)))
    seen = [(moment, run) for moment, _, run in done if moment.number in whole or (run / PARTS).is_file()]
    parted = [(moment, run) for moment, run in seen if moment.number not in whole]
    history = History.of([Parts.read(run / PARTS) for _, run in parted])
    numbers, times = [moment.number for moment, _ in parted], [moment.time for moment, _ in parted]
    write_rows(folder.events, EVENT_COLUMNS, history.event_rows(numbers, times))
    write_rows(folder.tracks, TRACK_COLUMNS, history.track_rows(numbers, times))
    write_rows(folder.table, COLUMNS, _lines(folder, found))
    write_rows(folder.bodies, BODY_COLUMNS, _body_lines(found))
    if fronts:
        numbers, when = [moment.number for moment, _ in seen], [moment.time for moment, _ in seen]
        write_rows(folder.fronts, FRONT_COLUMNS, front_rows(numbers, when, [_front(run) for _, run in seen]))
    write_page(folder.page, replace(page_of(folder, found), events=tuple(history.lines(times))))
    return found


def _front(run: Path) -> Front:
    """Of the object that a run found, on voxels of the pixels."""
    folder = RunFolder(run)
    summary = folder.read_summary()
    seen, total = summary["detector"], summary.get("total")
    grid = Grid.centred((seen["columns"], seen["rows"], seen["columns"]), seen["pixel_size_m"])
    told = TotalMatter.from_dict(total).profile if total else None
    return Front.of(read_object(folder.object).voxelise(grid), told)


def _lines(folder: SeriesFolder, found: Collected) -> Iterable[list[object]]:
    states = {state.number: state for state in found.states}
    for moment, row, task, run in zip(found.moments, found.rows, found.tasks, found.runs):
        source = str(found.plan.sources[moment.source].path)
        where: list[object] = [moment.number, source, moment.frame, f"{moment.time:.9g}", task]
        if row is None or not row.done:
            status = "failed" if row is not None else states[task].state.replace("done", "left")
            yield [*where, status, *[""] * (len(COLUMNS) - 9), row.reason if row else states[task].reason, "", ""]
            continue
        scores = [_number(part.get(name)) for part in (row.test, row.train) for name in ("ssim", "frcm")]
        said = [row.begun, row.kind, "" if row.good is None else int(row.good), _number(row.unexplained), *scores]
        told = [_number(row.total), _number(row.total_error), len(row.bodies), f"{row.seconds:.3f}"]
        yield [
            *where,
            "done",
            *said,
            *told,
            *_rehearsed(run),
            run.relative_to(folder.path).as_posix(),
            "",
            row.decided,
            row.words,
        ]


def _rehearsed(run: Path) -> list[str]:
    """The verdict by rehearsals of a run, and the ends of what they say; empty where none were made."""
    found = read_rehearsal(RunFolder(run))
    if found is None:
        return [""] * 4
    return [found.word, *(f"{each:.6g}" for each in (*found.total_ends, found.least_dice))]


def _body_lines(found: Collected) -> Iterable[list[object]]:
    for moment, row, names in zip(found.moments, found.rows, found.bodies):
        if row is not None:
            for name, body in sorted(zip(names, row.bodies)):
                yield [moment.number, f"{moment.time:.9g}", name, *(f"{value:.6g}" for value in body)]


def _number(value: object) -> str:
    return "" if value is None else f"{number_in(str(value)):.6g}"


def page_of(folder: SeriesFolder, found: Collected) -> SeriesPage:
    """The content of series.html."""
    from .page import Frame, SeriesPage, headline

    frames = []
    for moment, row, run, names in zip(found.moments, found.rows, found.runs, found.bodies):
        if row is not None and row.done:
            shared = run / f"t{moment.number:04d}.{PHASE}"
            phase = shared if shared.is_file() else run / PHASE
            frames.append(Frame(row, moment.time, phase, run.relative_to(folder.path).as_posix(), names))
    failed = {f"task {s.number}": plain(s.reason) for s in found.states if s.state == "failed"}
    missing = len(found.missing)
    verdict = "All times are done." if not missing else f"{missing} of {len(found.moments)} times are missing."
    notes = [
        f"task {task}: bodies are {1e6 * apart:.3g} µm from where the task before has them"
        for task, apart in found.agreement.items()
        if apart == apart
    ]
    notes += [found.no_events] if found.no_events else []
    chosen = begun_motion(folder.path)
    summary = f"{time_left(found.states)}." + (f" {chosen.line.replace('-', '−')}." if chosen else "")
    return SeriesPage("A series", headline(verdict, frames), summary, tuple(frames), failed, tuple(notes))
