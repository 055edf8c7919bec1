"""One time of a series: begun with what the time before ended with, or by itself, into a run folder and a row."""

from __future__ import annotations

import shutil
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from ..bodies.rest_shape import moments
from ..checks import InputError
from ..io.atomic import atomic_path
from ..matter import MaterialPrior
from ..methods import Method
from ..methods.continued import Continued
from ..progress import FitProgress
from ..representations import Stored, SurfaceMesh
from ..scan import Scan
from ..units import wavenumber
from ..workflows.evaluate import Evaluation, evaluate
from ..workflows.reconstruct import reconstruct
from ..workflows.reconstruction import Reconstruction
from ..workflows.run_folder import RunFolder, claimed
from .folder import Begun, Body, Row
from .plan import Settings

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
