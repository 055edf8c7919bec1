"""`reconstruct` of matter in motion: a scan of several times in, Gaussians that a flow carries and their folder out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from ..checks import require
from ..fit.residuals import Prediction
from ..io.light import write_light
from ..io.objects import write_object
from ..matter import KnownTwo, MaterialPrior
from ..methods import Task
from ..methods.assumed import assumed_material
from ..methods.illumination import prepared
from ..methods.presets import SCHEMA
from ..methods.uncertain import Uncertain
from ..motion.flow_reconstruction import NOWHERE, CarriedOptions, Search, merged
from ..optics.background import LightOptions
from ..optics.sampling import fringe_sampling
from ..progress import FitProgress
from ..representations import VoxelGrid
from ..scan import Scan
from ..tables import to_table
from .choice import Choice
from .provenance import environment, scan_hash
from .reconstruction import Reconstruction
from .resume import goes_on
from .run_folder import Checkpoint, RunFolder
from .run_light import found_in
from .run_record import summary_of
from .suitable import check_frames
from .verdict import judge

KIND = "carried"
"""The method's name in the files of a run."""
USUAL = CarriedOptions()
"""The options by default."""


@dataclass(frozen=True)
class Motion:
    """What was found of matter in motion. reconstruction: `object.at(t)` is the matter at any time [s]; volume: of the
    flow's reference time, on voxels; history: what was asked of the frames on the way, in words."""

    reconstruction: Reconstruction
    volume: VoxelGrid
    history: tuple[str, ...]


def reconstruct_moving(
    scan: Scan,
    prior: MaterialPrior,
    options: CarriedOptions = USUAL,
    seed: int = 0,
    *,
    light: LightOptions | None = None,
    ask: bool = True,
    folder: RunFolder | None = None,
    resume: bool = False,
    on_progress: FitProgress = lambda stage, fraction, record: None,
) -> Motion | None:
    """Continuous matter that moves through the training frames of `scan`, of several times; None where nothing moves.

    `reconstruction.object` of the result is a `MovingGaussians`. ask: whether the frames are asked first if anything
    moves; without, it does. light: what is assumed of it (default: even, unless air says otherwise). A material that is
    not known is estimated from the mean of all times. With a `folder`, everything is written there, unless nothing
    moves, and every step is kept; a later call with `resume=True` goes on from the last one, with the same result, bit
    for bit, as if nothing had happened. Errors: `InputError` for a scan of one or two times, frames that are not
    relative to the flat field, two materials, and folders that do not fit.
    """
    require(not isinstance(prior, KnownTwo), "a flow carries one material, but two are known; leave --second-material.")
    train = scan.train()
    count = len(train.instants)
    require(
        count >= 3,
        f"matter in motion needs training frames of three times or more, but theirs are of {count}; choose a time.",
    )
    check_frames(train)
    assumed = light or LightOptions()
    config = _config(scan, prior, options, seed, assumed)
    going = goes_on(folder, config, resume)
    task = prepared(Task(train, prior, seed, lambda stage, part: on_progress(stage, part, {}), assumed))
    mean = merged(task.scan)
    material = assumed_material(mean, task.prior, task.on_progress)
    search = Search(task, material, options, NOWHERE if folder is None else Checkpoint(folder))
    if going:
        search.take_up()
    elif ask and not search.moves(search.by_itself(mean, "mean of all times")):
        return None
    if folder is not None and not going:
        folder.begin(config | environment("cpu"))
        search.keep()
    found = search.run()
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
        light=found_in(task),
    )
    if folder is not None:
        folder.start_metrics([])
        write_object(folder.object, found.object, folder.marks())
        if task.uneven is not None and task.uneven.background is not None:
            write_light(folder.light, task.uneven.background, marks=folder.marks())
        seen = {"times_s": task.scan.instants.tolist(), "misfit": found.misfit, "asked": list(found.history)}
        folder.write_summary(summary_of(done, None, task.scan) | seen | {"light": task.light_in_words})
    return Motion(done, found.volume, found.history)


def begun_in_motion(folder: RunFolder) -> bool:
    """Whether a folder holds a run of matter in motion, finished or not."""
    return folder.config.is_file() and folder.read_config().get("method", {}).get("kind") == KIND


def _config(
    scan: Scan, prior: MaterialPrior, options: CarriedOptions, seed: int, light: LightOptions
) -> dict[str, Any]:
    """What config.json says the run is of."""
    return {
        "schema_version": SCHEMA,
        "method": {"kind": KIND, **to_table(options)},
        "matter": "continuous",
        "seed": seed,
        "prior": prior.as_dict(),
        "scan_hash": scan_hash(scan),
        "light": to_table(light),
        "uncertain": to_table(Uncertain()),
        "refine": None,
    }
