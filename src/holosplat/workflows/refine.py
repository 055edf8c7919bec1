"""`reconstruct` of beams that are not where they say: poses of training frames before the matter, of held-out after."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from ..align.find import align_views
from ..align.geometry import Geometry
from ..align.held_out import fitted_frames, place_frames
from ..align.poses import PoseOptions, PosePrior
from ..align.views import KINDS
from ..checks import as_written, require
from ..fit.pose_refinement import PoseRefinement
from ..io.json import read_json, write_json
from ..matter import MaterialPrior
from ..methods.keeper import where
from ..methods.uncertain import Uncertain
from ..optics.background import LightOptions
from ..progress import Progress
from ..scan import Scan
from .provenance import scan_hash
from .reconstruction import Reconstruction
from .run_folder import RunFolder
from .run_illumination import light_of

STILL = 1e-6
"""Changes [pixels, degrees, share] of the training frames below which their kind stays as planned for all frames."""


def require_compatible(ranges: Uncertain) -> None:
    """`InputError` where the constants of the frames themselves are uncertain, too."""
    stray = [name for name in ("distance", "energy_kev") if name in ranges.given()]
    require(
        not stray,
        f"--refine needs the distance and energy of the plan, but {' and '.join(stray)} is said as a range; give "
        "one of them, and refine the distance after that.",
    )


def trained_geometry(
    scan: Scan, prior: MaterialPrior, options: PoseOptions, light: LightOptions, on_progress: Progress
) -> Geometry:
    """The poses of the training frames of `scan`, estimated from these alone; held-out ones are as planned."""
    found = align_views(scan.train(), prior, options, light=light, on_progress=on_progress)
    return Geometry.of_training(scan, found, options.uncertain)


def saved_geometry(folder: RunFolder | None, resume: bool) -> Geometry | None:
    """That of a run that goes on; None where there is none yet."""
    if folder is None or not resume or not folder.config.is_file():
        return None
    with as_written(folder.config, "of a run that has begun"):
        table = folder.read_config().get("decided", {}).get("geometry")
        return None if table is None else Geometry.from_dict(table)


def still_uncertain(geometry: Geometry, uncertain: PosePrior) -> PosePrior:
    """`uncertain` without what stayed as planned for all training frames."""
    changes = geometry.changes[~geometry.held_out]
    return replace(uncertain, **{name: 0.0 for name in KINDS if not _moved(changes, KINDS[name])})


def freedom_of(geometry: Geometry | None, options: PoseOptions | None) -> PoseRefinement | None:
    """What fits may still change of where the training frames are; None where nothing is refined."""
    if geometry is None or options is None:
        return None
    changes = geometry.changes[~geometry.held_out]
    so_far = np.concatenate([changes[:, :2], np.deg2rad(changes[:, 2:5]), changes[:, 5:]], axis=1)
    return still_uncertain(geometry, options.uncertain).freedom(so_far)


def with_fitted(
    geometry: Geometry, planned: Scan, fitted: Scan, done: Reconstruction, options: PoseOptions
) -> Geometry:
    """`geometry` with the training frames of the `planned` scan where a fit has put them: as `fitted` are."""
    at = np.flatnonzero(~planned.is_test)
    if all(np.array_equal(part.numpy(), getattr(geometry, name)[at]) for name, part in where(fitted.exposures).items()):
        return geometry
    options = replace(options, uncertain=still_uncertain(geometry, options.uncertain))
    return geometry.with_frames(at, fitted_frames(done.object, planned[at], fitted, options, done.oversample))


def with_held_out(
    geometry: Geometry, scan: Scan, done: Reconstruction, options: PoseOptions, on_progress: Progress
) -> Geometry:
    """`geometry` with the held-out frames of the planned `scan` where the matter that was found puts them.

    What stayed as planned for all training frames stays so here.
    """
    at, uncertain = np.flatnonzero(scan.is_test), still_uncertain(geometry, options.uncertain)
    if not len(at) or not any(getattr(uncertain, name) for name in KINDS):
        return geometry
    lit = light_of(scan, done.light, done.still)
    if lit is not None:
        scan = replace(scan, frames=lit.evened(torch.from_numpy(scan.frames)).numpy())
    found = place_frames(done.object, scan[at], replace(options, uncertain=uncertain), on_progress, done.oversample)
    return geometry.with_frames(at, found)


def _moved(changes: np.ndarray, places: tuple[int, ...]) -> bool:
    return bool(np.abs(changes[:, list(places)]).max() > STILL)


def read_geometry(summary: Mapping[str, Any]) -> Geometry | None:
    """That of a run's summary.json; None where nothing was refined."""
    table = summary.get("geometry")
    return None if table is None else Geometry.from_dict(table)


def keep_geometry(folder: RunFolder, geometry: Geometry, scan: Scan) -> None:
    """Write `geometry` into the folder of a finished run, and what the planned `scan` is with it."""
    folder.write_summary(folder.read_summary() | {"geometry": geometry.as_dict()})
    config = folder.read_config()
    decided = config["decided"] | {"scan_hash": scan_hash(geometry.applied(scan))}
    write_json(folder.config, config | {"decided": decided})


def where_found(folder: RunFolder, scan: Scan) -> Scan:
    """`scan` with the exposures that the run in `folder` found, if it is the one that was reconstructed, as planned."""
    if not folder.summary.is_file():
        return scan
    with as_written(folder.summary, "what reconstruct wrote"):
        geometry = read_geometry(read_json(folder.summary))
    if geometry is None or scan_hash(scan) != folder.read_config().get("scan_hash"):
        return scan
    return geometry.applied(scan)
