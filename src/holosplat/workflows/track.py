"""A scan of several times in, matter in motion and its run folder out: closed bodies (`track`), or Gaussians that a
flow carries (`reconstruct_moving`)."""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ..bodies.rest_shape import KnownBody
from ..checks import as_written, require
from ..fit.residuals import Prediction
from ..fit.run import Run
from ..io.atomic import atomic_folder, write_rows
from ..io.paraview import TimeStep, write_pvd
from ..io.vtk import write_mesh
from ..matter import KnownSeveral, MaterialPrior
from ..methods import Task
from ..methods.cross_validation import assumed_material
from ..methods.illumination import prepared
from ..methods.method import one_material
from ..motion.body_tracker import Followed, require_times
from ..motion.elastic import Rest, strain_energy
from ..motion.flow_reconstruction import FlowOptions, FlowResult, FlowSearch, merged
from ..motion.forecast import Forecast
from ..motion.measures import columns, measured, row, standard_errors
from ..motion.track import USUAL, follow, require_prior
from ..motion.track_linking import TrackOptions
from ..optics.background import LightOptions
from ..optics.sampling import fringe_sampling
from ..progress import FitProgress
from ..representations import InMotion, MovingSurfaces, VoxelGrid
from ..scan import Scan
from ..tables import read_rows
from .choice import Choice
from .preconditions import check_frames, goes_on, require_kinds
from .provenance import environment
from .reconstruction import Reconstruction, config_of, write_rest, write_run
from .run_folder import RunFolder, claimed
from .run_illumination import light_options_of
from .verdict import judge

LENGTH_UNIT = "um"
BODIES, COLLECTION, TRACKS = "bodies", "bodies.pvd", "tracks.csv"
STRAIN = "strain_energy_J"
"""The column of energies beside the shape at rest."""
ERROR = "se_"
"""How the names of columns with standard errors begin."""
USUAL_FLOW = FlowOptions()
"""How matter in motion is reconstructed by default."""


def track(
    scan: Scan,
    prior: MaterialPrior,
    options: TrackOptions = USUAL,
    seed: int = 0,
    *,
    light: LightOptions | None = None,
    after: Forecast | None = None,
    folder: RunFolder | None = None,
    resume: bool = False,
    on_progress: FitProgress = lambda stage, fraction, record: None,
) -> Reconstruction:
    """Reconstruct closed bodies of one material that move through the training frames of `scan`, of several times.

    light: assumptions about the light (default: even, unless air shows otherwise)
    after: forecast of these times by earlier ones, as the prior of the paths (a filter over windows of time); its
        bodies stay, and others are looked for beside them
    folder: where to write what `reconstruct` writes, and `bodies.pvd` with one VTK file (.vtp, µm) a body and time, and
        `tracks.csv`; a later call with `resume=True` continues from the last checkpoint, with the same result

    `object` of the result is a `MovingSurfaces`: `object.at(t)` holds at any time [s], between frames too. A material
    that is not known is estimated from the first time. Ctrl-C (KeyboardInterrupt) is passed on. Errors: `InputError`
    for a scan of one time, frames that are not relative to the flat field, two materials, no body that is seen, and
    folders that do not fit.

    Examples:

        >>> from dataclasses import replace
        >>> import numpy as np
        >>> import holosplat as hs
        >>> from holosplat.motion.track import TrackOptions
        >>> water = hs.materials.parse_material("water").delta_beta(20.0)
        >>> (cell,) = hs.specimens.random_cells(1, box=(16e-6, 16e-6, 16e-6), seed=1)
        >>> times, speed = np.array([0.0, 1e-5, 2e-5]), 0.05  # s, m/s along y
        >>> ways = [cell.transformed(np.eye(3), [0.0, speed * time, 0.0]) for time in times]
        >>> series = hs.specimens.MeshSeries([hs.MeshScene.of_one_material([each], water) for each in ways], times)
        >>> views = hs.Views.evenly_spaced(4, shape=(24, 24), pixel_size=1e-6)
        >>> exposures = hs.Exposures.of(views, energy_kev=20.0, distance=0.05).repeated(times)
        >>> scan = hs.simulate(series, exposures, is_test=np.zeros(len(exposures)))
        >>> quick = replace(TrackOptions(), intervals=False).with_effort(0.1)
        >>> found = hs.track(scan, hs.MaterialPrior.known(water), quick).object
        >>> found.count
        1
        >>> first, last = (found.bodies(time)[0].vertices.mean(0) for time in times[[0, -1]])
        >>> print(f"{(last - first)[1] / times[-1]:.2f} m/s")
        0.05 m/s
    """
    require_kinds(scan, prior, options)
    scan.views.parallel("following motion")
    require(
        not isinstance(prior, KnownSeveral), "bodies are of one material, but several are known; give --material once."
    )
    require_times(scan.train())
    require_prior(after, options, scan.train().instants)
    check_frames(scan.train())
    assumed = light or LightOptions()
    config = config_of(scan, prior, options, seed, "levels", assumed)
    config |= {} if after is None else {"after": _hash(after)}
    with claimed(folder):
        if folder is not None and not goes_on(folder, config, resume):
            folder.begin(config | environment("cpu"))
        task = prepared(Task(scan.train(), prior, seed, lambda stage, part: on_progress(stage, part, {}), assumed))
        train = task.scan
        material = assumed_material(train.at_instant(0), one_material(task), task.on_progress)
        found = follow(
            train, material, options, seed, light=task.uneven, after=after, journal=folder, on_progress=on_progress
        )
        decisions, against = (*task.decisions, *found.decisions), task.prior.against
        choice = Choice("levels", {}, "soft fit", found.begun, decisions, against)
        done = _in_motion(found, found.bodies, task, choice, found.oversample)
        if folder is not None:
            folder.start_metrics(dict.fromkeys(name for record in found.records for name in record))
            folder.append_metrics(found.records)
            if found.rest is not None:
                write_rest(folder, found.rest)
            told = {"steps": len(found.records), "times_s": task.scan.instants.tolist(), "bodies": found.bodies.count}
            told |= {"bodies_at_each_time": list(found.found)}
            told |= {} if np.isnan(found.moved) else {"moved_from_forecast": found.moved}
            write_run(folder, done, task, None, told)
            write_tracks(folder, found.bodies, scan, _more(found, scan))
        return done


def _hash(forecast: Forecast) -> str:
    """A short fingerprint (SHA-256) of a forecast."""
    arrays = forecast.times, forecast.band, forecast.bodies.coefficients.detach().numpy()
    return hashlib.sha256(b"".join(np.ascontiguousarray(each).tobytes() for each in arrays)).hexdigest()[:16]


def _in_motion(
    found: FlowResult | Followed, obj: InMotion, task: Task, choice: Choice, oversample: int
) -> Reconstruction:
    """The matter in motion that was `found`, with the verdict on all times."""
    exposures, noise = task.scan.exposures, task.noise if task.uneven else None
    kind = TrackOptions.kind if isinstance(found, Followed) else FlowOptions.kind
    return Reconstruction(
        obj,
        kind,
        exposures.reference_energy,
        oversample,
        found.timing,
        True,
        choice,
        task.delta_told,
        judge(Prediction(obj, exposures, oversample), task.scan, noise),
        light=light_options_of(task),
        rest=_rest(found) if isinstance(found, Followed) else None,
    )


def _rest(found: Followed) -> Rest | None:
    if found.rest is None:
        return None
    stiffness = KnownBody.stiffness if found.body is None else found.body.stiffness  # as `read_rest` has it
    return Rest.of(found.rest, stiffness, found.bodies.unit_length)


def _more(found: Followed, scan: Scan) -> dict[str, np.ndarray]:
    """Columns of tracks.csv [T, B] beside those of every run: the strain energy of red cells, and standard errors."""
    red_cells = found.body is not None and found.body.shape == "red-cell"  # whose moduli are known
    more = {STRAIN: strain_energy(found.bodies, scan.instants, found.rest)} if red_cells and found.rest else {}
    errors = standard_errors(found.bodies, found.halves, scan)
    return more | {f"{ERROR}{name}": values for name, values in errors.items()}


def read_errors(folder: RunFolder) -> dict[str, np.ndarray]:
    """The standard errors [T, B] of tracks.csv, by their columns; empty where there are none."""
    path = folder.path / TRACKS
    with as_written(path, "what track wrote"):
        rows = read_rows(path, "what track wrote")
        names = [name for name in rows[0] if name.startswith(ERROR)] if rows else []
        times = len({row["time_s"] for row in rows})
        return {n.removeprefix(ERROR): np.array([float(row[n]) for row in rows]).reshape(times, -1) for n in names}


def write_tracks(
    folder: RunFolder, bodies: MovingSurfaces, scan: Scan, more: Mapping[str, np.ndarray] | None = None
) -> None:
    """tracks.csv, with `more` columns [T, B] by their names, and bodies.pvd with one file a body and time."""
    times, steps, beside = scan.instants, list[TimeStep](), more or {}
    rows = (
        [*row(one), *(f"{column.ravel()[k]:.4g}" for column in beside.values())]
        for k, one in enumerate(measured(bodies, scan.exposures))
    )
    write_rows(folder.path / TRACKS, [*columns(), *beside], rows)
    if (folder.path / BODIES).is_dir():  # of a run that was cut off when it wrote
        shutil.rmtree(folder.path / BODIES)
    with atomic_folder(folder.path / BODIES) as temporary:
        for t, time in enumerate(times):
            named = [(f"{mesh.name}_{t:04d}.vtp", mesh) for mesh in bodies.bodies(float(time))]
            for name, mesh in named:
                write_mesh(temporary / name, mesh, LENGTH_UNIT)
            steps.append(TimeStep(float(time), tuple(folder.path / BODIES / name for name, _ in named)))
    write_pvd(folder.path / COLLECTION, steps)


@dataclass(frozen=True)
class FlowReconstruction:
    """The result for moving matter. reconstruction: `object.at(t)` is the matter at any time [s]; volume: at the flow's
    reference time, on voxels; history: the decisions on the way, in words."""

    reconstruction: Reconstruction
    volume: VoxelGrid
    history: tuple[str, ...]


def reconstruct_moving(
    scan: Scan,
    prior: MaterialPrior,
    options: FlowOptions = USUAL_FLOW,
    seed: int = 0,
    *,
    light: LightOptions | None = None,
    ask: bool = True,
    folder: RunFolder | None = None,
    resume: bool = False,
    on_progress: FitProgress = lambda stage, fraction, record: None,
) -> FlowReconstruction | None:
    """Continuous matter that moves through the training frames of `scan`, of several times; None where nothing moves.

    `reconstruction.object` of the result is a `MovingGaussians`. ask: whether to test for motion first; without, matter
    is taken to move. light: what is assumed of it (default: even, unless air says otherwise). A material that is
    not known is estimated from the mean of all times. With a `folder`, everything is written there, unless nothing
    moves, and every step is kept; a later call with `resume=True` goes on from the last one, with the same result, bit
    for bit, as if nothing had happened. Errors: `InputError` for a scan of one or two times, frames that are not
    relative to the flat field, two materials, and folders that do not fit.
    """
    scan.views.parallel("following motion")
    require(
        not isinstance(prior, KnownSeveral), "a flow carries one material, but several are known; give --material once."
    )
    train = scan.train()
    count = len(train.instants)
    require(
        count >= 3,
        f"matter in motion needs training frames of three times or more, but theirs are of {count}; choose a time.",
    )
    check_frames(train)
    assumed = light or LightOptions()
    config = config_of(scan, prior, options, seed, "continuous", assumed)
    going = goes_on(folder, config, resume)
    task = prepared(Task(train, prior, seed, lambda stage, part: on_progress(stage, part, {}), assumed))
    mean = merged(task.scan)
    material = assumed_material(mean, one_material(task), task.on_progress)
    search = FlowSearch(task, material, options, Run(folder))
    if not going and ask and not search.moves(search.by_itself(mean, "mean of all times")):
        return None
    if folder is not None and not going:
        folder.begin(config | environment("cpu"))
        search.run.keep()
    found = search.solve()
    decisions, against = (*task.decisions, *found.decisions), task.prior.against
    choice = Choice("continuous", {}, "Gaussians", decisions=decisions, against=against)
    done = _in_motion(found, found.object, task, choice, fringe_sampling(train.exposures))
    if folder is not None:
        folder.start_metrics([])
        seen = {"times_s": task.scan.instants.tolist(), "misfit": found.misfit, "asked": list(found.history)}
        write_run(folder, done, task, None, seen)
    return FlowReconstruction(done, found.volume, found.history)


def begun_in_motion(folder: RunFolder) -> bool:
    """Whether a folder holds a run of matter in motion, finished or not."""
    return folder.config.is_file() and folder.read_config().get("method", {}).get("kind") == FlowOptions.kind
