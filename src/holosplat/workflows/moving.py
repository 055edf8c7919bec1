"""`reconstruct` of moving continuous matter: Gaussians that a flow carries, from a scan of several times."""

from __future__ import annotations

from dataclasses import dataclass

from ..checks import require
from ..fit.residuals import Prediction
from ..fit.run import Run
from ..matter import KnownSeveral, MaterialPrior
from ..methods import Task
from ..methods.assumed import assumed_material
from ..methods.illumination import prepared
from ..motion.flow_reconstruction import FlowOptions, FlowSearch, merged
from ..optics.background import LightOptions
from ..optics.sampling import fringe_sampling
from ..progress import FitProgress
from ..representations import VoxelGrid
from ..scan import Scan
from ..tables import to_table
from .choice import Choice
from .preconditions import check_frames, goes_on
from .provenance import environment
from .reconstruction import Assumptions, Reconstruction, config_of, write_run
from .run_folder import RunFolder
from .run_illumination import light_options_of
from .verdict import judge

KIND = "carried"
"""The method's name in the files of a run."""
USUAL = FlowOptions()
"""The options by default."""


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
    options: FlowOptions = USUAL,
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
    method = {"kind": KIND, **to_table(options)}
    config = config_of(scan, prior, method, seed, "continuous", Assumptions(assumed))
    going = goes_on(folder, config, resume)
    task = prepared(Task(train, prior, seed, lambda stage, part: on_progress(stage, part, {}), assumed))
    mean = merged(task.scan)
    material = assumed_material(mean, task.prior, task.on_progress)
    search = FlowSearch(task, material, options, Run(folder))
    if not going and ask and not search.moves(search.by_itself(mean, "mean of all times")):
        return None
    if folder is not None and not going:
        folder.begin(config | environment("cpu"))
        search.run.keep()
    found = search.solve()
    oversample = fringe_sampling(train.exposures)
    said = Prediction(found.object, task.scan.exposures, oversample)
    decisions = (*task.decisions, *found.decisions)
    done = Reconstruction(
        found.object,
        KIND,
        train.exposures.reference_energy,
        oversample,
        found.timing,
        True,
        Choice("continuous", {}, "Gaussians", decisions=decisions, against=task.prior.against),
        task.delta_told,
        judge(said, task.scan, task.noise if task.uneven else None),
        light=light_options_of(task),
    )
    if folder is not None:
        folder.start_metrics([])
        seen = {"times_s": task.scan.instants.tolist(), "misfit": found.misfit, "asked": list(found.history)}
        write_run(folder, done, task, None, seen)
    return FlowReconstruction(done, found.volume, found.history)


def begun_in_motion(folder: RunFolder) -> bool:
    """Whether a folder holds a run of matter in motion, finished or not."""
    return folder.config.is_file() and folder.read_config().get("method", {}).get("kind") == KIND
