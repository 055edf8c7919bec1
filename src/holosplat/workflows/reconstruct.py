"""`reconstruct`: a scan in, a reconstructed Object and its run folder out, by any method."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from ..align.poses import PoseOptions
from ..backends import in_main_memory, resolve
from ..checks import InputError, as_written, note, positive
from ..fit.run import Record, Run, Running
from ..inference import Decision
from ..io.atomic import write_json
from ..io.light import read_still_light
from ..io.volumes import write_guess
from ..learning.start import GuessedMatter
from ..matter import MaterialPrior, MatterKind
from ..methods import Auto, Gaussians, Method, Settled, Task, finished, learned, require_possible, settled
from ..methods.cross_validation import first_picture
from ..methods.illumination import prepared
from ..methods.keeper import Keeper
from ..methods.method import Ended, Look, run_stages
from ..methods.trials import unseen_kinds
from ..methods.uncertain import Determined, Uncertain
from ..optics.background import LightOptions
from ..optics.sampling import fringe_sampling
from ..progress import PICTURE, FitProgress, FitState
from ..ranges import require_plausible
from ..representations import Stored
from ..scan import Scan
from .choice import Choice
from .preconditions import (
    check_frames,
    decided_before,
    decided_there,
    decisions_of,
    goes_on,
    is_complete,
    require_kinds,
    require_one_time,
)
from .provenance import environment, scan_hash
from .reconstruction import (
    Reconstruction,
    config_of,
    freedom_of,
    keep_geometry,
    read_geometry,
    read_rest,
    require_compatible,
    saved_geometry,
    trained_geometry,
    with_fitted,
    with_held_out,
    write_run,
)
from .run_folder import RunFolder, claimed
from .run_illumination import fixed_pattern_of, light_options_of, read_light_options
from .totals import TotalMatter, total_of_run
from .verdict import Verdict, judge_run, said_of_run


def reconstruct(
    scan: Scan,
    prior: MaterialPrior,
    method: Method = Auto(),
    seed: int = 0,
    *,
    light: LightOptions | None = None,
    matter: MatterKind | None = None,
    uncertain: Uncertain | None = None,
    refine: PoseOptions | None = None,
    folder: RunFolder | None = None,
    resume: bool = False,
    on_progress: FitProgress = lambda stage, fraction, record: None,
    on_state: FitState | None = None,
) -> Reconstruction:
    """Reconstruct the object in the training frames of `scan`: the best state of `method` by these frames.

    light: assumptions about the light (default: as the frames show; see `illumination.prepared`)
    matter: "levels", with sharp edges, or "continuous" (default: chosen from the data)
    uncertain: ranges of distance, energy or δ/β (default: exact), which the result estimates as `constants`
    refine: how to estimate poses, too (default: as in the scan); the result has them as `geometry`
    folder: for all files; with `resume=True` a later call continues from the last checkpoint, to the same result
    on_state: is first given a coarse volume, within a second or so, then better ones as they come (`FitState`); where
        there can be no coarse one, a note says why. The result is the same with and without

    Ctrl-C (KeyboardInterrupt) ends a fit with the state that it has reached (`finished` is False). Errors: `InputError`
    for scans without training frames or matter, or of several times where `method` takes one, for other folders,
    and for tasks and kinds of matter that the method cannot do.

    Examples:

        >>> import holosplat as hs
        >>> water = hs.materials.parse_material("water").delta_beta(20.0)
        >>> views = hs.Views.evenly_spaced(8, shape=(16, 16), pixel_size=1e-6)
        >>> cells = hs.specimens.random_cells(1, box=(16e-6, 16e-6, 16e-6), seed=1)
        >>> scene = hs.MeshScene.of_one_material(cells, water)
        >>> scan = hs.simulate(scene, hs.Exposures.of(views, energy_kev=20.0, distance=0.05))
        >>> result = hs.reconstruct(scan, hs.MaterialPrior.known(water))
        >>> volume = result.object.voxelise(hs.Grid.of_views(views))
        >>> volume.delta.shape
        (16, 16, 16)
        >>> error = volume.delta.sum() / scene.voxelise(volume.grid).delta.sum() - 1
        >>> bool(abs(error) < 0.05)
        True
    """
    require_kinds(scan, prior, method)
    if not method.of_series:
        require_one_time(scan)
    if not method.cones:
        scan.views.parallel(f"the method {method.kind}")
    if refine is not None:
        scan.views.parallel("finding poses")
    check_frames(scan.train())
    require_possible(method, prior, matter)
    if not resume:  # a run that goes on may be past them
        method.require_files()
    assumed, ranges, planned = light or LightOptions(), uncertain or Uncertain(), scan
    config = config_of(scan, prior, method, seed, matter or "auto", assumed, uncertain=ranges, refine=refine)

    def tell(stage: str, part: float) -> None:
        on_progress(stage, part, {})

    with claimed(folder):
        if folder is not None and resume and refine is None and is_complete(folder, config):
            return load_reconstruction(folder)
        goes_on(folder, config, resume)
        run, geometry = _FolderRun(folder, on_progress, on_state), None
        if on_state is not None and not run.saved:
            _show_first(scan, prior, on_state)
        if refine is not None:
            require_compatible(ranges)
            geometry = saved_geometry(folder, resume) or trained_geometry(scan, prior, refine, assumed, tell)
            scan = geometry.applied(scan)
        task = Task(
            scan.train(), prior, seed, tell, assumed, freedom=freedom_of(geometry, refine), on_start=run.start_at
        )
        if isinstance(method, Gaussians):
            resolve(method.fit.backend)  # before the decision, which takes its time
        if folder is not None and run.saved:
            with as_written(folder.config, "of a run that has begun"):
                decided = folder.read_config()["decided"]
                found, before = Settled.again(method, decided), decided_before(decided)
            task = prepared(task, method, before)
        else:
            with run.timed("decision"):
                task = prepared(task, method, decided_there(method))
                found = settled(method, task, matter, ranges)
        task = found.task(task)
        if isinstance(method, Auto) and method.gaussians.start == "learned" and found.matter == "continuous":
            run.start = (learned.NOT_ASKED,)
        where_fitted = {} if geometry is None else {"geometry": geometry.as_dict()}
        decided = found.as_table() | decisions_of(task) | {"scan_hash": scan_hash(found.placed(scan))} | where_fitted
        run.config = config | {"decided": decided}
        keeper = Keeper(task.scan, found.method.mixes_kinds, unseen_kinds(task, found.method))
        with run.as_written():
            keeper.load(run.saved.get("kept"))
        run.state = lambda: {"kept": keeper.state_dict(), "decided": [each.as_dict() for each in run.start]}
        ended = _with_best(run_stages(found.method, task, run.shows(keeper.look), run), keeper)
        done = _reconstruction(run, ended, keeper, found, method.kind)
        if refine is None or geometry is None:
            return done
        geometry = with_fitted(geometry, planned, ended.task.scan, done, refine)
        geometry = with_held_out(geometry, planned, done, refine, tell)
        if folder is not None:
            keep_geometry(folder, geometry, planned)
        return replace(done, geometry=geometry)


def _show_first(scan: Scan, prior: MaterialPrior, on_state: FitState) -> None:
    """Show a coarse volume before all work, or say why there is none."""
    try:
        found = first_picture(scan.train(), prior)
    except InputError as error:
        note(f"there is no first picture: {error}")
        return
    on_state(PICTURE, 0.0, {}, lambda: found)


def load_reconstruction(folder: RunFolder) -> Reconstruction:
    """Load the reconstruction in a run folder. Errors: `InputError` if it holds none.

    Examples:

        >>> import holosplat as hs
        >>> water = hs.materials.parse_material("water").delta_beta(20.0)
        >>> views = hs.Views.evenly_spaced(8, shape=(16, 16), pixel_size=1e-6)
        >>> cells = hs.specimens.random_cells(1, box=(16e-6, 16e-6, 16e-6), seed=1)
        >>> scene = hs.MeshScene.of_one_material(cells, water)
        >>> scan = hs.simulate(scene, hs.Exposures.of(views, energy_kev=20.0, distance=0.05))
        >>> run = hs.RunFolder("run")
        >>> _ = hs.reconstruct(scan, hs.MaterialPrior.known(water), hs.preset("fast"), folder=run)
        >>> result = hs.load_reconstruction(hs.RunFolder("run"))
        >>> result.method, result.energy_kev, result.finished
        ('gaussians', 20.0, True)
    """
    folder.require_run()
    summary, config = folder.read_summary(), folder.read_config()
    found = folder.read_result()
    folder.require_own(folder.light)
    still = read_still_light(folder.light) if folder.light.is_file() else None
    with as_written(folder.summary, "what reconstruct wrote"):
        require_plausible(summary)
        timing = {name: float(value) for name, value in summary["timing_s"].items()}
        energy, oversample = positive("energy_kev", summary["energy_kev"]), int(summary["oversample"])
        done, method = bool(summary["finished"]), str(summary.get("method", Gaussians.kind))
        plain = summary.get("backend") == "reference"  # then it is judged without compiled kernels, too
        told = bool(summary.get("material", {}).get("delta_told", True))
        said = Verdict.from_dict(summary["verdict"]) if "verdict" in summary else None
        total = TotalMatter.from_dict(summary["total"]) if "total" in summary else None
        constants = tuple(Determined.from_dict(each) for each in summary.get("constants", ()))
        choice, geometry = Choice.read(summary), read_geometry(summary)
        with as_written(folder.config, "what reconstruct wrote"):
            light = read_light_options(config, summary)
    told_of = (choice, told, said, total, constants, light, geometry, still, read_rest(folder, found, config))
    found = found.on("reference" if plain else "cpu")
    return Reconstruction(found, method, energy, oversample, timing, done, *told_of)


class _FolderRun(Run):
    """A run whose folder is kept up to date: config.json, metrics, and a checkpoint in each fit. Ctrl-C ends a fit.

    config: entries of config.json; start: the decisions on what fits start from
    """

    def __init__(self, folder: RunFolder | None, on_progress: FitProgress, on_state: FitState | None) -> None:
        super().__init__(folder)
        self.folder, self.on_progress, self.on_state = folder, on_progress, on_state
        self.config, self._pending = dict[str, Any](), list[Record]()
        self._guess: GuessedMatter | None = None
        with self.as_written():
            self.start = tuple(Decision.from_dict(each) for each in self.saved.get("decided", ()))

    def shows(self, look: Look) -> Look:
        """`look`, and then what stages begin and end with is shown."""

        def both(name: str, found: Stored, oversample: int, fitted: bool, train: Scan) -> None:
            look(name, found, oversample, fitted, train)
            if self.on_state is not None:
                self.on_state(name, float(name != "start"), {}, lambda: found.on(in_main_memory(found.backend)))

        return both

    def start_at(self, decision: Decision, guess: GuessedMatter | None) -> None:
        """Take in what a fit starts from, in place of what was decided of it before."""
        others = (each for each in self.start if each.name != decision.name)
        self.start, self._guess = (*others, decision), guess or self._guess

    def make_folder(self, backend: str) -> None:
        """Make the folder, once there is something to put in it."""
        if self.folder is not None and not self.folder.config.is_file():
            self.folder.begin(self.config | environment(backend))
            if self._guess is not None:
                write_guess(self.folder.guess, self._guess.volume, self._guess.spread, self._guess.of_copies)

    def fit(self, name: str, fit: Running, show: Callable[[Record], None] = lambda record: None) -> bool:
        """Run a fit, or the rest of it, with metrics and checkpoints; whether it came to its end."""
        again = self.take_up(fit)
        self.make_folder(fit.backend)
        if self.folder is not None:
            config = self.folder.read_config()
            found = config.get("resolved", {}) | {name: {"oversample": fit.oversample, **fit.resolved()}}
            write_json(self.folder.config, config | {"resolved": found})
            if not again and (number := self.state()["stage"]):
                self.folder.set_aside_metrics(number - 1)
            self.folder.start_metrics(fit.columns(), keep_until=fit.step)
        self._fit = fit
        self.keep()

        def look(record: Record) -> None:
            self._pending.append(record)
            self.on_progress(name, fit.share, record)
            if self.on_state is not None:
                self.on_state(name, fit.share, record, lambda: finished(fit).on(in_main_memory(fit.backend)))

        complete = False
        try:
            complete = super().fit(name, fit, look)
        except KeyboardInterrupt:
            self.on_progress("interrupted", 1.0, {})
        self.timing[name] = fit.seconds
        self.keep()
        return complete

    def keep(self) -> None:
        """Write metrics and a checkpoint, which is always of a fit."""
        if self.folder is not None and self._fit is not None:
            self.folder.append_metrics(self._pending)
            self._pending.clear()
            super().keep()


def _with_best(ended: Ended, keeper: Keeper) -> Ended:
    """The best state of stages that came to their end, in place of the last one."""
    if not ended.complete or keeper.best is None:
        return ended
    scan = replace(ended.task.scan, exposures=keeper.best.exposures)
    return ended._replace(object=keeper.best.object, task=replace(ended.task, scan=scan))


def _reconstruction(run: _FolderRun, ended: Ended, keeper: Keeper, found: Settled, asked: str) -> Reconstruction:
    """The result, written to the folder."""
    obj, task, fit, complete = ended
    best, exposures = keeper.best if complete else None, task.scan.exposures
    assert obj is not None
    oversample = (best.oversample if best else fit.oversample if fit else 0) or fringe_sampling(exposures)
    decisions = (*task.decisions, *run.start, *(keeper.decisions if best else ()))
    total = None  # of several times, at which it may differ
    if not found.method.of_series:
        total = total_of_run(*said_of_run(obj, fit, task, oversample), task, found.constants)
    done = Reconstruction(
        obj.on(in_main_memory(obj.backend)),
        asked,
        exposures.reference_energy,
        oversample,
        dict(run.timing),
        complete,
        Choice.of(task, dict(keeper.judged), best.name if best else "", decisions),
        task.delta_told,
        judge_run(obj, fit, task, oversample),
        total,
        found.constants,
        light_options_of(task),
        still=fixed_pattern_of(task, found.method, obj, oversample),
    )
    if run.folder is not None:
        run.make_folder(obj.backend)
        if fit is None:
            run.folder.start_metrics([])
        times = {"times_s": task.scan.instants.tolist()} if found.method.of_series else {}
        write_run(run.folder, done, task, fit, times)
    return done
