"""A window of times whose bodies are followed through all of them at once: one run, and a row a time."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..bodies.moments import moments
from ..io.run_scan import run_source
from ..metrics import ImageScores
from ..representations import MovingSurfaces
from ..scan import Scan
from ..workflows.evaluate import Evaluation, evaluate
from ..workflows.reconstruction import Reconstruction
from ..workflows.run_folder import RunFolder, claimed
from ..workflows.track import track
from .plan import SeriesPlan, Source
from .rows import Row
from .time import PHASE, write_phase


def track_window(scan: Scan, source: Source, plan: SeriesPlan, rows: Sequence[Row], folder: RunFolder) -> list[Row]:
    """Follow the bodies through the times of `rows`, and fill these in; a run that is there is gone on with.

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
