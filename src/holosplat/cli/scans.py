"""What commands do with finished runs: the frames to compare them with, scores, predictions, rehearsals."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from ..checks import as_written, require
from ..io.atomic import read_json, require_writable
from ..io.formats import read_frames, read_volume_file, run_reading, run_source
from ..io.nxtomo import write_scan
from ..io.reading import Part, Reading, at_time
from ..methods.continued import Continued
from ..methods.presets import method_of
from ..methods.solve import Settled
from ..scan import Scan
from ..series.collect import collect
from ..series.folder import SeriesFolder
from ..series.plan import prior_of
from ..tables import from_table
from ..units import number_of
from ..volume import Volume
from ..workflows.evaluate import TIMES, Evaluation, evaluate, render, require_overlap, require_same_field, write_times
from ..workflows.preconditions import require_one_time
from ..workflows.provenance import scan_hash
from ..workflows.reconstruct import load_reconstruction
from ..workflows.reconstruction import Reconstruction, instants_of, reconstruction_at, where_found
from ..workflows.rehearsal import rehearse
from ..workflows.run_folder import RunFolder, claimed
from ..workflows.verdict import Verdict
from .progress import ProgressBar
from .sentence import interruptible, put, say, tell_result

if TYPE_CHECKING:
    from ..report.compare import Side


KEPT = "interrupted; the rehearsals that are done are kept, and the same command goes on"
TRUTH = "truth"
"""The file of source.json by which a run was evaluated, for pages that are written again."""


def scan_for(folder: RunFolder, scan: Path | None, reading: Reading) -> Scan:
    """A scan to compare a run with, at the time that the run is of. scan: None is the run's own, read as the run did
    and as `reading` says, where it found the geometry to be."""
    own = run_reading(folder.path) if folder.source.is_file() else Reading()
    if scan is None:
        found = read_frames(folder.source_scan(), reading.over(own))
    else:
        found = read_frames(scan, reading)
        if found.is_series:
            found = at_time(found, own.part.time_frame)
    if found.is_series and not instants_of(folder):
        require_one_time(found)
    return where_found(folder, found.in_memory())


def run_and_scan(folder: RunFolder, scan: Path | None, reading: Reading) -> tuple[Reconstruction, Scan]:
    """A run, and the scan to compare it with (`scan_for`); of a run in motion both at --time-frame, or at all times.
    Errors: `InputError` for times that the run does not have."""
    result, times = load_reconstruction(folder), instants_of(folder)
    if not times:
        return result, scan_for(folder, scan, reading)
    frame = reading.part.time_frame
    if isinstance(frame, int):
        result = reconstruction_at(result, times, frame)
    else:
        reading = replace(reading, part=replace(reading.part, time_frame=None))
    return result, scan_for(folder, scan, reading)


def runs_of(path: Path) -> list[tuple[float, RunFolder]]:
    """The times [s] of a series, and their run folders; nothing for what is no series."""
    series = SeriesFolder(path)
    windows = series.plan().windows() if series.file.is_file() else ()
    each = [(window.number, moment) for window in windows for moment in window.own]
    return [(moment.time, RunFolder(series.run_of(task, moment.number))) for task, moment in each]


def report_run(
    folder: RunFolder, result: Reconstruction, shown: Scan, found: Evaluation, truth: Volume | None, remark: str = ""
) -> Path:
    """Write the report of a run, which takes seconds, and first load what draws it."""
    say("report …")
    from ..report.run import report_run as write

    return write(folder, result, shown, found, truth, remark)


def report_of_middle(folder: RunFolder, result: Reconstruction, measured: Scan) -> Path:
    """The report of a run of several times at the one in the middle."""
    times = measured.train().instants.tolist()
    middle = len(times) // 2
    shown = measured[(measured.exposures.time == times[middle]).nonzero()[0]].as_static()
    now = reconstruction_at(result, times, middle)
    whole = f"This is the time {1e6 * times[middle]:.4g} µs, of {len(measured)} frames of {len(times)} times in all."
    return report_run(folder, now, shown, evaluate(now, shown, None), None, whole)


def scored(
    folder: RunFolder, result: Reconstruction, measured: Scan, scan: Path, reading: Reading
) -> tuple[Path, Verdict | None]:
    """Print the scores of a run on its frames, and write its report; the folder then knows where its frames are. The
    report, and the verdict on held-out frames."""
    found = reading.told.found({each.name: each.value for each in result.constants})
    folder.write_source(run_source(scan, replace(reading, told=found)))
    placed = result.placed(measured)
    evaluation = evaluate(result, placed, None)
    put(evaluation.lines())
    if reading.part.time_frame in ("all", "still"):
        every = replace(reading, told=reading.told.at_middle(), part=replace(reading.part, time_frame=None))
        each = result.placed(read_frames(scan, every)).in_memory()
        write_times(folder.path / TIMES, result, each, evaluation.light)
    if instants_of(folder):
        return report_of_middle(folder, result, placed), evaluation.verdict
    return report_run(folder, result, placed, evaluation, None), evaluation.verdict


def tell_found(folder: RunFolder, result: Reconstruction, report: Path) -> None:
    """What was found and decided, and whether it explains the frames."""
    if folder.light.is_file():
        say(f"light: {read_json(folder.summary)['light']} ({folder.light})")
    put(constant.line() for constant in result.constants)
    put(result.geometry.lines() if result.geometry else ())
    put(result.choice.lines())
    tell_result(folder, result, report)
    if result.total:
        print(result.total.words)
    if not instants_of(folder):
        act = f"holosplat rehearse {folder.path}"
        say(f"not rehearsed: for intervals of these numbers, and a verdict beside them: {act}")


def predict(run: Path, scan: Path, out: Path, split: str, reading: Reading) -> None:
    """Write the frames of a split of a scan as a run predicts them."""
    require_writable(out)
    result, wanted = run_and_scan(RunFolder(run), scan, reading)
    chosen = {"test": wanted.test, "train": wanted.train, "all": lambda: wanted}[split]()
    require(len(chosen) > 0, f"{scan} has no {split} frames to render; choose another --split.")
    frames = render(result, chosen.exposures)
    write_scan(out, Scan(frames, chosen.exposures, chosen.is_test, {"rendered_from": run.name}))
    say(f"wrote {out}: {number_of(len(frames), 'predicted frame')}")


def _known_truth(folder: RunFolder, result: Reconstruction) -> Volume | None:
    """The truth that the run was evaluated by, if it is there."""
    told = read_json(folder.source).get(TRUTH) if folder.source.is_file() else None
    return read_volume_file(Path(told), result.delta_told) if isinstance(told, str) and Path(told).is_file() else None


def judge(run: Path, scan: Path | None, truth: Path | None, as_json: bool, reading: Reading) -> None:
    """Print the scores of a run, by a truth, too, and renew its report by that."""
    folder = RunFolder(run)
    result, measured = run_and_scan(folder, scan, reading)
    predicted = scan is None and folder.path.resolve() in folder.source_scan().resolve().parents
    require(
        not predicted or truth is not None,
        f"{run} is a forecast of times without frames, so that only its own predictions could score it; name frames by "
        "--scan, or a --truth.",
    )
    true_volume = read_volume_file(truth, result.delta_told) if truth else None
    if truth is not None and true_volume is not None:
        require_same_field(true_volume.grid, measured.views, truth)
        wall = measured.exposures.wall
        true_volume = wall.content(true_volume) if wall else true_volume
    evaluation = evaluate(result, None if predicted else measured, true_volume)
    if truth is not None and evaluation.volume is not None:
        require_overlap(evaluation.volume, truth)
    if as_json:
        print(json.dumps(evaluation.as_dict(), indent=2, allow_nan=False))
    else:
        put(evaluation.lines())
    if instants_of(folder):
        return  # its report is of the time in the middle
    if not folder.is_of(scan_hash(measured)):
        say("this is not the scan that was reconstructed, its frames may have been fitted; report unchanged")
    elif true_volume is not None or not folder.report.exists():
        with claimed(folder):
            if truth is not None and folder.source.is_file():
                folder.write_source({**read_json(folder.source), TRUTH: str(truth.resolve())})
            say(f"report: {report_run(folder, result, measured, evaluation, true_volume)}")


def side_of_run(path: Path) -> Side:
    """A run with its scores, as far as its scan is still there."""
    from ..report.compare import side_of

    folder, scan = RunFolder(path), None
    folder.require_run()
    told = read_json(folder.source).get("scan") if folder.source.is_file() else None
    if told and Path(str(told)).exists():
        scan = scan_for(folder, None, Reading(part=Part(time_frame=0)) if instants_of(folder) else Reading())
    return side_of(folder, scan)


def rehearse_each(run: Path, times: int, bins: int | None, reading: Reading) -> None:
    """Rehearse a run, or every time that is done of a series, whose table is then written again."""
    each, seen = runs_of(run), set[Path]()
    for number, (_, folder) in enumerate(each):
        if folder.path in seen or not folder.result().is_file():
            continue
        seen.add(folder.path)
        moves = bool(instants_of(folder))
        say(f"time {number}: {f'not rehearsed, for {folder.path} is of matter in motion' if moves else ''}".rstrip())
        if not moves:
            _rehearse(folder, times, bins, reading)
    if each:
        collect(series := SeriesFolder(run))
        say(f"wrote {series.table}")
    else:
        _rehearse(RunFolder(run), times, bins, reading)


def _rehearse(folder: RunFolder, times: int, bins: int | None, reading: Reading) -> None:
    several = f"rehearse takes a run of matter at one time, but {folder.path} is of several; name a run of one time."
    require(not instants_of(folder), several)
    result, measured = run_and_scan(folder, None, reading)
    config = folder.read_config()
    with as_written(folder.config, "what reconstruct wrote"):
        told = dict(config["method"])
        method = from_table(Continued, told) if told.get("kind") == Continued.kind else method_of(told, "method")
        method = Settled.again(method, config["decided"]).method
        prior, seed = prior_of(config["prior"]), int(config["seed"])
    with claimed(folder):
        with interruptible(lambda: KEPT), ProgressBar() as bar:
            how = {"times": times, "bins": bins, "seed": seed, "folder": folder, "on_progress": bar.show}
            found = rehearse(result, measured, prior, method, **how)
        truth = _known_truth(folder, result)
        page = report_run(folder, result, measured, evaluate(result, measured, truth), truth)
    put(found.lines())
    say(f"report: {page}")
