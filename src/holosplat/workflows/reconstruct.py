"""`reconstruct`: a scan in, a reconstructed Object and its run folder out, by any method."""

from __future__ import annotations

import time
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from typing import Any, cast

import torch

from ..align.geometry import Geometry
from ..align.poses import PoseOptions
from ..backends import in_main_memory, resolve
from ..checks import as_written, positive, require
from ..fit.run import Record, Running
from ..inference import Decision
from ..io.json import write_json
from ..io.light import read_still_light
from ..io.volumes import write_guess
from ..learning.start import GuessedMatter
from ..matter import MaterialPrior, MatterKind
from ..methods import Auto, Gaussians, Method, Settled, Stage, Task, begun, finished, learned, settled
from ..methods.illumination import prepared
from ..methods.keeper import Keeper, placed_at, where
from ..methods.kinds import unseen_kinds
from ..methods.uncertain import Determined, Uncertain
from ..optics.background import LightOptions
from ..optics.sampling import fringe_sampling
from ..progress import FitProgress, FitState
from ..ranges import require_plausible
from ..representations import KINDS, Stored
from ..scan import Scan
from ..tables import to_table
from .choice import Choice
from .preconditions import (
    check_frames,
    decided_before,
    decisions_of,
    goes_on,
    is_complete,
    require_alike,
    require_one_time,
)
from .provenance import environment, scan_hash
from .reconstruction import Assumptions, Reconstruction, config_of, read_rest, write_run
from .refine import (
    freedom_of,
    keep_geometry,
    read_geometry,
    require_compatible,
    saved_geometry,
    trained_geometry,
    with_fitted,
    with_held_out,
)
from .run_folder import RunFolder, claimed
from .run_illumination import fixed_pattern_of, light_options_of, read_light_options
from .totals import TotalMatter, total_of_run
from .verdict import Verdict, judge_run, said_of_run

CHECKPOINT_SECONDS = 20.0


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
    on_state: FitState = lambda stage, fraction, record, state: None,
) -> Reconstruction:
    """Reconstruct the object in the training frames of `scan`: the best state of `method` by these frames.

    light: assumptions about the light (default: as the frames show; see `illumination.prepared`)
    matter: "levels", with sharp edges, or "continuous" (default: chosen from the data)
    uncertain: ranges of distance, energy or δ/β (default: exact), which the result estimates as `constants`
    refine: how to estimate poses, too (default: as in the scan); the result has them as `geometry`
    folder: for all files; with `resume=True` a later call continues from the last checkpoint, to the same result

    Ctrl-C (KeyboardInterrupt) ends a fit with the state that it has reached (`finished` is False). Errors: `InputError`
    for scans without training frames or matter, or of several times where `method` takes one, for other folders,
    and for tasks that the method cannot do.

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
    if not method.of_series:
        require_one_time(scan)
    check_frames(scan.train())
    if not resume:  # a run that goes on may be past them
        method.require_files()
    assumed, ranges, planned = light or LightOptions(), uncertain or Uncertain(), scan
    asked = Assumptions(assumed, ranges, refine)
    config = config_of(scan, prior, to_table(method), seed, matter or "auto", asked)

    def tell(stage: str, part: float) -> None:
        on_progress(stage, part, {})

    with claimed(folder):
        if folder is not None and resume and refine is None and is_complete(folder, config):
            return load_reconstruction(folder)
        geometry = None
        if refine is not None:
            require_compatible(ranges)
            goes_on(folder, config, resume)
            geometry = saved_geometry(folder, resume) or trained_geometry(scan, prior, refine, assumed, tell)
            scan = geometry.applied(scan)
        train = scan.train()
        task = Task(train, prior, seed, tell, assumed, freedom=freedom_of(geometry, refine))
        run = _Run(task, method, folder, on_progress, on_state)
        run.begin(config, resume)
        run.prepare()
        run.settle(matter, ranges, scan, geometry)
        done = run.complete()
        if refine is None or geometry is None:
            return done
        geometry = with_fitted(geometry, planned, run.task.scan, done, refine)
        geometry = with_held_out(geometry, planned, done, refine, tell)
        if folder is not None:
            keep_geometry(folder, geometry, planned)
        return replace(done, geometry=geometry)


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


@dataclass
class _Run:
    """A reconstruction in progress: the stages one after another, and the folder kept up to date."""

    task: Task
    method: Method
    folder: RunFolder | None
    on_progress: FitProgress
    on_state: FitState
    timing: dict[str, float] = field(default_factory=dict)
    asked: str = ""
    constants: tuple[Determined, ...] = ()
    start: tuple[Decision, ...] = ()
    _keeper: Keeper = field(init=False)
    _saved: dict[str, Any] | None = None
    _config: dict[str, Any] = field(default_factory=dict)
    _guess: GuessedMatter | None = None

    def begin(self, config: dict[str, Any], resume: bool) -> None:
        """Look at the folder, and at what of the run is there already; writes nothing."""
        self._config, self.asked = config, self.method.kind
        self.task = replace(self.task, on_start=self._note_start)
        self._keeper = Keeper(self.task.scan, mixed=self.method.mixes_kinds)
        if self.folder is None or not goes_on(self.folder, config, resume):
            return
        self._saved = self.folder.load_checkpoint()
        if self._saved:
            with self.as_written():
                self.timing |= {str(name): float(seconds) for name, seconds in self._saved["timing"].items()}
                self.start = tuple(Decision.from_dict(each) for each in self._saved.get("decided", ()))
                self._keeper.load(self._saved["kept"])

    def prepare(self) -> None:
        """Decide on light and noise, or do as was decided before."""
        began = time.perf_counter()
        if isinstance(self.method, Gaussians):
            resolve(self.method.fit.backend)  # before the decision, which takes its time
        before = decided_before(self.folder) if self._saved and self.folder is not None else None
        self.task = prepared(self.task, self.method, before)
        if before is None:
            self.timing["decision"] = time.perf_counter() - began

    def settle(
        self, matter: MatterKind | None, uncertain: Uncertain, scan: Scan, geometry: Geometry | None = None
    ) -> None:
        """Decide on what is uncertain, on the kind of matter, and on the method where that is `auto`; or do as was
        decided before. scan: the whole one, with its test frames, in the `geometry` of its training frames."""
        began = time.perf_counter()
        if self._saved and self.folder is not None:
            with as_written(self.folder.config, "of a run that has begun"):
                found = Settled.again(self.method, self.folder.read_config()["decided"])
        else:
            found = settled(self.method, self.task, matter, uncertain)
            self.timing["decision"] = self.timing.get("decision", 0.0) + time.perf_counter() - began
        asked = isinstance(self.method, Auto) and self.method.gaussians.start == "learned"
        self.start = (learned.NOT_ASKED,) if asked and found.matter == "continuous" else self.start
        self.method, self.constants = found.method, found.constants
        self.task = found.task(self.task)
        self._keeper.train = self.task.scan
        self._keeper.unseen = unseen_kinds(self.task, self.method)
        where: dict[str, Any] = {} if geometry is None else {"geometry": geometry.as_dict()}
        self._config["decided"] = (
            found.as_table() | decisions_of(self.task) | {"scan_hash": scan_hash(found.placed(scan))} | where
        )

    def complete(self) -> Reconstruction:
        """Run the remaining stages."""
        found: Stored | None = None
        with self.as_written():
            stages, first = self.method.stages(), int(self._saved["stage"]) if self._saved else 0
            require(first < len(stages), f"stage must be below {len(stages)}, but it is {first}.")
        last: Running | None = None
        for number in range(first, len(stages)):
            stage, saved = stages[number], self._saved if number == first else None
            before = found
            start = self._start_again(saved) if saved else self._started(stage, before)
            fit = stage.fit(self.task.in_windows(), start)
            oversample = fit.oversample if fit else 0
            if saved is None and start is not before and (number == 0 or fit is None):
                self._keeper.look(stage.name if number else "start", start, oversample, fitted=False)
            if fit is None:
                found = start
                continue
            last = fit
            complete = self._fitted(fit, number, start, saved["fit"] if saved else None)
            self.timing[stage.name] = fit.seconds
            found = cast(Stored, finished(fit))
            self.task = replace(self.task.moved(fit.result()), near=False)
            self._keeper.moved(self.task.scan)
            if not complete:
                return self._result(found, fit, False)
            self._keeper.look(stage.name, found, oversample, fitted=not self.method.likelier)
        assert self._keeper.best is not None
        self.task = replace(self.task, scan=replace(self.task.scan, exposures=self._keeper.best.exposures))
        return self._result(self._keeper.best.object, last, True)

    def as_written(self) -> AbstractContextManager[None]:
        """In which what a checkpoint lacks is an `InputError`."""
        return as_written(self.folder.checkpoint if self.folder else "", "a checkpoint of this run")

    def _start_again(self, saved: dict[str, Any]) -> Stored:
        """What the stage of a checkpoint began with; the frames are where they were then."""
        with self.as_written():
            self._go_back(saved)
            self.task = replace(self.task, near=bool(saved.get("near", False)))
            return KINDS[saved["start"]["kind"]].from_state(saved["start"]["state"])

    def _go_back(self, saved: dict[str, Any]) -> None:
        """To where the frames were when the stage of a checkpoint began."""
        if self.task.freedom is not None:
            scan = replace(self.task.scan, exposures=placed_at(self.task.scan.exposures, saved["placed"]))
            self.task = replace(
                self.task, scan=scan, freedom=replace(self.task.freedom, so_far=saved["so_far"].numpy())
            )
            self._keeper.moved(scan)

    def _fitted(self, fit: Running, number: int, start: Stored, saved: dict[str, Any] | None) -> bool:
        """Run the fit of stage `number`, from a `saved` state if there is one, and keep metrics and checkpoints up to
        date; whether it came to its end."""
        if saved is not None:
            with self.as_written():
                require_alike(saved, fit.state_dict())
                fit.load(saved)
        name, pending, last = self.method.stages()[number].name, list[Record](), time.perf_counter()
        self._make_folder(fit.backend)
        self._note_resolved(name, fit)

        def save() -> None:
            nonlocal last
            if self.folder is None:
                return
            self.folder.append_metrics(pending)
            pending.clear()
            self.folder.save_checkpoint(self._state(fit, number, start))
            last = time.perf_counter()

        def on_record(record: Record) -> None:
            pending.append(record)
            self.on_progress(name, fit.share, record)
            self.on_state(name, fit.share, record, lambda: finished(fit).on(in_main_memory(fit.backend)))
            up_to_date = record["step"] == fit.step  # on a GPU, records come late and in batches
            if up_to_date and time.perf_counter() - last > CHECKPOINT_SECONDS:
                save()

        if self.folder is not None:
            if saved is None and number:
                self.folder.set_aside_metrics(number - 1)
            self.folder.start_metrics(fit.columns(), keep_until=fit.step)
            save()
        complete = True
        try:
            fit.run(on_record)
        except KeyboardInterrupt:
            complete = False
            self.on_progress("interrupted", 1.0, {})
        save()
        return complete and fit.finished

    def _state(self, fit: Running, number: int, start: Stored) -> dict[str, Any]:
        """The checkpoint of stage `number`: the poses at its beginning, its fit, and the best state before it."""
        freedom = self.task.freedom
        placed = {} if freedom is None else {"placed": where(self.task.scan.exposures)}
        so_far = {} if freedom is None else {"so_far": torch.from_numpy(freedom.so_far)}
        return {
            "stage": number,
            "start": {"kind": start.kind, "state": start.state()},
            "fit": fit.state_dict(),
            "timing": self.timing,
            "kept": self._keeper.state_dict(),
            "near": self.task.near,
            "decided": [each.as_dict() for each in self.start],
            **placed,
            **so_far,
        }

    def _started(self, stage: Stage, before: Stored | None) -> Stored:
        began = time.perf_counter()
        start, self.task = begun(stage, self.task, before)
        self.timing["start"] = self.timing.get("start", 0.0) + time.perf_counter() - began
        return start

    def _note_start(self, decision: Decision, guess: GuessedMatter | None) -> None:
        self.start, self._guess = (decision,), guess

    def _make_folder(self, backend: str) -> None:
        """Make the folder, once there is something to put in it."""
        if self.folder is not None and not self.folder.config.is_file():
            self.folder.begin(self._config | environment(backend))
            if self._guess is not None:
                write_guess(self.folder.guess, self._guess.volume, self._guess.spread, self._guess.of_copies)

    def _note_resolved(self, stage: str, fit: Running) -> None:
        """Add to config.json what the options have become in a stage: wave samples a pixel, weights and widths."""
        if self.folder is not None:
            config = self.folder.read_config()
            found = {"oversample": fit.oversample, **fit.resolved()}
            write_json(self.folder.config, config | {"resolved": config.get("resolved", {}) | {stage: found}})

    def _result(self, found: Stored, fit: Running | None, complete: bool) -> Reconstruction:
        exposures, best = self.task.scan.exposures, self._keeper.best if complete else None
        samples, kept = best.oversample if best else fit.oversample if fit else 0, best.name if best else ""
        oversample = samples or fringe_sampling(exposures)
        decisions = (*self.task.decisions, *self.start, *(self._keeper.decisions if best else ()))
        done = Reconstruction(
            found.on(in_main_memory(found.backend)),
            self.asked,
            exposures.reference_energy,
            oversample,
            dict(self.timing),
            complete,
            Choice.of(self.task, dict(self._keeper.judged), kept, decisions),
            self.task.delta_told,
            judge_run(found, fit, self.task, oversample),
            self._total(found, fit, oversample),
            self.constants,
            light_options_of(self.task),
            still=fixed_pattern_of(self.task, self.method, found, oversample),
        )
        if self.folder is not None:
            self._make_folder(found.backend)
            if fit is None:
                self.folder.start_metrics([])
            times = {"times_s": self.task.scan.instants.tolist()} if self.method.of_series else {}
            write_run(self.folder, done, self.task, fit, times)
        return done

    def _total(self, found: Stored, fit: Running | None, oversample: int) -> TotalMatter | None:
        """The total of the matter; None of several times, at which it may differ."""
        if self.method.of_series:
            return None
        return total_of_run(*said_of_run(found, fit, self.task, oversample), self.task, self.constants)
