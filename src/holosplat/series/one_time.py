"""One time of a series, reconstructed by itself or from the time before, and its row."""

from __future__ import annotations

import shutil
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ..bodies.rest_shape import moments
from ..checks import InputError
from ..frames import block_means
from ..geometry import Grid
from ..inference import Compared, Decision, Score
from ..io.atomic import atomic_path, read_json, write_json
from ..io.formats import run_source
from ..io.guard import read_array
from ..io.reading import Reading
from ..matter import MaterialPrior
from ..methods import Method, Task
from ..methods.continued import Continued
from ..methods.contrast import with_sign
from ..methods.illumination import prepared
from ..methods.keeper import NAME, Keeper
from ..methods.trials import decide_kind
from ..progress import FitProgress, FitState
from ..representations import Stored, SurfaceMesh, VoxelGrid
from ..scan import Scan
from ..units import wavenumber
from ..workflows.evaluate import Evaluation, evaluate, render
from ..workflows.preconditions import decided_before
from ..workflows.reconstruct import load_reconstruction, reconstruct
from ..workflows.reconstruction import Reconstruction
from ..workflows.run_folder import RunFolder, claimed
from ..workflows.totals import TotalMatter
from .events import PARTS, Parts
from .folder import Body, Row
from .plan import Settings, at, prior_of, times_of

PHASE = "phase.npy"
"""The phase in the first view [rad], for pages."""
BEGUN, BACK, CONSERVED, REFERENCE = "begun.json", "back.json", "conserved.json", "reference.npy"
"""How a time was begun, where that was decided; the same on the way back, and with the others' total; and what the last
time that was begun by itself, or was compared with one that was, left of its frames: the powers of a `Score`."""
Told = tuple[float, ...]
"""A total δ and its standard error [m³], or nothing."""
WHAT = "what a time left of its frames"
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

    @classmethod
    def of(cls, scan: Scan, path: Path, prior: MaterialPrior, reading: Reading, row: Row) -> Shot:
        """The time `row.frame` of the whole `scan` in the file `path`, read as `reading` says."""
        frame = row.frame if len(times_of(scan)) > 1 else None
        source = run_source(path, replace(reading, part=replace(reading.part, time_frame=frame)))
        return cls(at(scan, row.frame), prior, source, row)


@dataclass(frozen=True)
class Before:
    """The time before, or on the way back the time after: the folder of its run and its row."""

    folder: RunFolder
    row: Row


def quiet(stage: str, fraction: float, record: dict[str, float]) -> None:
    """Progress that nobody looks at."""


def reconstruct_time(
    shot: Shot,
    settings: Settings,
    folder: RunFolder,
    before: Before | None = None,
    on_progress: FitProgress = quiet,
    on_state: FitState | None = None,
) -> Row:
    """Reconstruct one time into `folder`, and say what came of it; an unfinished run is continued.

    A time that goes on from the one before is also begun by itself, if its last round still is of use, for then matter
    has changed much, or if it explains its frames surely less well than the last time that began by itself explains its
    own. The better one is kept (`_better`). on_state: as of `reconstruct`. Ctrl-C is passed on. Errors:
    `InputError` of `reconstruct`.
    """
    began, chosen = time.perf_counter(), folder.path / BEGUN
    if before is None or not settings.warm.on or not _same_field(before, shot.scan):
        done = _run(shot, settings, settings.method, folder, on_progress, on_state=on_state)
        return _written(shot, settings, folder, done, replace(shot.row, begun="cold"), began)
    warm = Continued.of(settings.method, before.folder.object.resolve(), settings.warm.effort)
    said = read_json(chosen) if chosen.is_file() else {}
    if said.get("begun") == "anew":  # it was cut off after that
        done = _run(shot, settings, settings.method, folder, on_progress, on_state=on_state)
        return _written(shot, settings, folder, done, replace(shot.row, **said), began)
    _remove_other(folder, warm)
    done = _run(shot, settings, warm, folder, on_progress, before, on_state)
    row, reference = replace(shot.row, begun="warm"), before.folder.path / REFERENCE
    left = _left(done, shot.scan)
    if _settled(done) and _as_good(left, reference):
        _keep(folder, read_array(reference, WHAT))
        return _written(shot, settings, folder, done, row, began)
    alone = RunFolder(folder.path.with_name(f"{folder.path.name}.cold"))
    cold = _run(shot, settings, settings.method, alone, on_progress, on_state=on_state)
    decision = _better(shot, _known(before), settings, {"warm": done, "cold": cold}, alone)
    said = {"begun": "warm" if decision.choice == "warm" else "anew", "decided": decision.line}
    if decision.choice == "warm":
        shutil.rmtree(alone.path)
        _keep(folder, left.powers)
    else:
        write_json(alone.path / BEGUN, said)
        shutil.rmtree(folder.path)
        alone.path.rename(folder.path)
        done = cold
    return _written(shot, settings, folder, done, replace(shot.row, **said), began)


def is_worse(shot: Shot, own: Before, after: Before, later: Scan) -> bool:
    """Whether a finished time is to be tried again from the time after it, which has the frames `later`.

    So it is where it is not explained, and that one is, or explains its frames surely better; not where it was tried.
    """
    if (own.folder.path / BACK).is_file():
        return read_json(own.folder.path / BACK)["decided"] != own.row.decided  # it was cut off before its row
    if own.row.good or not _same_field(after, shot.scan):
        return False
    if after.row.good:
        return True
    mine = _left(load_reconstruction(own.folder), shot.scan)
    others = _left(load_reconstruction(after.folder), later)
    return mine.powers.shape == others.powers.shape and Compared("", *mine.gain_over(others)).loses


def retry_time(
    shot: Shot, settings: Settings, own: Before, after: Before, told: Told = (), on_progress: FitProgress = quiet
) -> Row:
    """Try a finished time again from the time after it; an unfinished try is continued.

    The better one is kept (`_better`), so that an error which a time handed on, or got from before, ends at the next
    good one. told: the total δ by all other times, with which the time is tried again from itself: as this has one
    unknown less, it is kept unless it explains the frames surely less well. Ctrl-C is passed on. Errors: `InputError`
    of `reconstruct`.
    """
    began, folder, begun = time.perf_counter(), own.folder, "conserved" if told else "back"
    method = Continued.of(settings.method, after.folder.object.resolve(), settings.warm.effort)
    method = replace(method, volume=replace(method.volume, known_total=tuple(told)))
    other, noted = RunFolder(folder.path.with_name(f"{folder.path.name}.{begun}")), f"{begun}.json"
    if (folder.path / noted).is_file():
        said = read_json(folder.path / noted)
        done = None if said["begun"] != begun else _run(shot, settings, method, folder, on_progress, after)
    else:
        _remove_other(other, method)
        tried, kept = _run(shot, settings, method, other, on_progress, after), load_reconstruction(folder)
        found = {"kept": kept, begun: tried} if told else {begun: tried, "kept": kept}
        decision = _better(shot, _known(after), settings, found, folder)
        done = None if decision.choice == "kept" else tried
        said = {"begun": begun if done else own.row.begun, "decided": decision.line}
        write_json((other if done else folder).path / noted, said)
        shutil.rmtree((folder if done else other).path)
        if done:
            other.path.rename(folder.path)
    if done is None:
        return replace(own.row, **said)
    row = _written(shot, settings, folder, done, replace(shot.row, **said), began)
    return replace(row, seconds=round(own.row.seconds + row.seconds, 3))


def common_totals(rows: Sequence[Row]) -> dict[int, Told]:
    """The total δ and its error [m³] that all other times tell of each one, where it may be conserved; else nothing.

    It is where a common total, one number in place of one a time, lowers the log-likelihood by less than as many, by
    Akaike's criterion (1974). Frames hardly tell slow changes, so that single totals may be far off.
    """
    known = [row for row in rows if row.total is not None and row.total_error]
    if len(known) < max(2, len(rows)):
        return {}
    values, errors = (np.array([getattr(row, name) for row in known]) for name in ("total", "total_error"))
    weights = errors**-2.0
    common = float(weights @ values / weights.sum())
    if 0.5 * float(weights @ (values - common) ** 2) >= len(known) - 1:
        return {}
    rest = weights.sum() - weights
    others = (common * weights.sum() - weights * values) / rest
    return {row.number: (float(at), float(of**-0.5)) for row, at, of in zip(known, others, rest)}


def is_conserved(own: Before) -> bool:
    """Whether a finished time was tried with the total of the others, and has its row."""
    noted = own.folder.path / CONSERVED
    return noted.is_file() and read_json(noted)["decided"] == own.row.decided


def is_spherical(own: Before) -> bool:
    """Whether a finished time is of spherical matter."""
    return _known(own).spherical


def is_without_bodies(own: Before) -> bool:
    """Whether a finished time is of continuous matter on both sides of its medium, or of spherical matter: it fills the
    field, and parts above half of its material's δ, which is that of a voxel somewhere, are no bodies."""
    if own.row.kind != VoxelGrid.kind:
        return False
    known = _known(own)
    return known.two_sided or known.spherical


def _left(done: Reconstruction, scan: Scan) -> Score:
    """The score of a result on the training frames of `scan`."""
    train = done.placed(scan).train()
    return Score.of(train.left(torch.from_numpy(render(done, train.exposures))))


def _keep(folder: RunFolder, powers: np.ndarray) -> None:
    """Write the reference for the times that follow."""
    with atomic_path(folder.path / REFERENCE) as temporary:
        np.save(temporary, powers, allow_pickle=False)


def _settled(done: Reconstruction) -> bool:
    """Whether the last round of a fit from before was of no use."""
    states = [each.compared for each in done.choice.decisions if each.name == NAME]
    return bool(states) and not states[-1][-1].loses


def _as_good(left: Score, reference: Path) -> bool:
    """Whether a result does not leave surely more than the last one that began by itself."""
    if not reference.is_file():
        return False
    other = Score(read_array(reference, WHAT), left.frames)
    return other.powers.shape == left.powers.shape and not Compared("", *left.gain_over(other)).loses


def _better(
    shot: Shot, prior: MaterialPrior, settings: Settings, found: Mapping[str, Reconstruction], by: RunFolder
) -> Decision:
    """The better one of two results, the null last: by the policy of a run's states (`Keeper`), in the light that
    the run `by` decided for; prior: of the result that goes on from another time, with its sides."""
    task = Task(shot.scan.train(), prior, settings.seed, light=settings.light)
    taken, _ = decided_before(by.read_config()["decided"])
    task = prepared(task, settings.method, (taken, ()))
    keeper = Keeper(task.scan, mixed=True, unseen=partial(decide_kind, task, settings.method))
    for name, done in found.items():
        keeper.look(name, done.object, done.oversample)
    return replace(keeper.decisions[0], name="begun")


def _same_field(before: Before, scan: Scan) -> bool:
    """Whether the time before was seen by the same pixels, at the same energy."""
    summary, views = before.folder.read_summary(), scan.views
    seen = summary["detector"]
    alike = (seen["rows"], seen["columns"]) == views.shape
    sizes = (seen["pixel_size_m"], views.finest), (summary["energy_kev"], scan.exposures.reference_energy)
    return alike and all(abs(a / b - 1) < 1e-6 for a, b in sizes)


def _remove_other(folder: RunFolder, method: Continued) -> None:
    """Remove a run that was continued from another file, as before its folder was moved: it is done again with the same
    numbers."""
    if folder.config.is_file() and folder.read_config().get("method", {}).get("begin") != str(method.begin):
        shutil.rmtree(folder.path)


def _run(
    shot: Shot,
    settings: Settings,
    method: Method,
    folder: RunFolder,
    on_progress: FitProgress,
    before: Before | None = None,
    on_state: FitState | None = None,
) -> Reconstruction:
    matter, prior = settings.matter, shot.prior
    if before is not None:  # it was decided there
        summary = before.folder.read_summary()
        matter = "continuous" if summary.get("decided", {}).get("matter") == "continuous" else "levels"
        prior = _known(before)
    done = reconstruct(
        shot.scan,
        prior,
        method,
        settings.seed,
        matter=matter,
        light=settings.light,
        folder=folder,
        resume=True,
        on_progress=on_progress,
        on_state=on_state,
    )
    if not done.finished:
        raise KeyboardInterrupt
    return done


def _known(before: Before) -> MaterialPrior:
    """The prior of a finished time, with the sides of the medium that were decided."""
    made = [Decision.from_dict(each) for each in before.folder.read_summary().get("decisions", ())]
    return with_sign(prior_of(before.folder.read_config()["prior"]), made)


def _share(done: Reconstruction) -> float:
    """Share of the matter that the result leaves unexplained in its frames."""
    return float(done.choice.judged.get(done.choice.kept, 0.0))


def _written(shot: Shot, settings: Settings, folder: RunFolder, done: Reconstruction, row: Row, began: float) -> Row:
    with claimed(folder):
        folder.write_source(shot.source)
        scan = done.placed(shot.scan)
        evaluation = evaluate(done, scan, None)
        write_phase(folder.path / PHASE, done.object, scan)
        if done.object.matter.delta and not is_without_bodies(Before(folder, filled(row, done, evaluation))):
            Parts.of(done.object, Grid.of_views(scan.views)).write(folder.path / PARTS)
        if not (folder.path / REFERENCE).is_file():
            _keep(folder, _left(done, shot.scan).powers)
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
    told = {} if done.total is None else told_of(done.total)
    verdict = done.verdict
    said = {} if verdict is None else {"good": verdict.good, "words": verdict.words}
    bodies = bodies_of(done.object)
    found = {"kind": done.object.kind, "size": done.object.described, "unexplained": _share(done), "bodies": bodies}
    return replace(row, status="done", **found, **means, **told, **said)


def told_of(total: TotalMatter) -> dict[str, Any]:
    """A total, as rows have it."""
    return {"quantity": total.quantity, "total": total.value, "total_error": total.error}


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
    binned = block_means(lines[0].cpu().numpy(), -(-max(views.shape) // MOST_PIXELS))
    with atomic_path(path) as temporary:
        np.save(
            temporary, (-wavenumber(scan.exposures.reference_energy) * binned).astype(np.float16), allow_pickle=False
        )
