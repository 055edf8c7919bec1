"""The result of `reconstruct`: object, decisions, estimates and poses that were found, and their entries in a run's
files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
import torch

from ..align.find import align_views
from ..align.geometry import Geometry
from ..align.held_out import fitted_frames, place_frames
from ..align.poses import PoseOptions, PosePrior
from ..align.views import KINDS
from ..backends import device_name
from ..bodies.rest_shape import KnownBody
from ..checks import as_written, require
from ..display import card, of_object
from ..fit.pose_refinement import PoseRefinement
from ..fit.run import Running
from ..geometry import Grid
from ..io.atomic import read_json, write_json
from ..io.light import write_light
from ..io.objects import write_object
from ..io.volumes import Contents
from ..io.vtk import read_meshes, write_mesh
from ..matter import MaterialPrior, MatterKind
from ..mesh import TriangleMesh
from ..methods import Task
from ..methods.keeper import where
from ..methods.presets import SCHEMA
from ..methods.uncertain import Determined, Uncertain, placed
from ..motion.elastic import Rest
from ..optics.background import LightOptions
from ..progress import Progress
from ..representations import InMotion, MovingSurfaces, Stored
from ..scan import Scan
from ..tables import to_table
from ..units import beam_named, wavelength
from .choice import Choice
from .provenance import scan_hash
from .run_folder import RunFolder
from .run_illumination import EVEN, light_of
from .totals import TotalMatter
from .verdict import Verdict


def summary_of(done: Reconstruction, fit: Running | None, train: Scan) -> dict[str, Any]:
    """Entries of summary.json; fit: the last one, if there was any."""
    (h, w), matter = train.views.shape, done.object.matter
    backend = fit.backend if fit else done.object.backend
    return {
        "finished": done.finished,
        "method": done.method,
        **done.choice.as_dict(),
        "kind": done.object.kind,
        "size": done.object.described,
        "backend": backend,
        "device": device_name(backend),
        "steps": fit.step if fit else 0,
        "stopped_early": bool(fit and fit.stopped_early),
        "best_step": (fit.best_step or fit.step) if fit else 0,
        "oversample": done.oversample,
        "detector": {
            **{"rows": h, "columns": w, "pixel_size_m": train.views.finest},
            "centre_m": Grid.of_views(train.views).centre.tolist(),
        },
        "energy_kev": done.energy_kev,
        "wavelength_m": wavelength(done.energy_kev),
        "material": {
            "delta": matter.delta,
            "beta": matter.beta,
            "single": matter.single,
            "delta_told": done.delta_told,
        },
        **({"wall": to_table(train.exposures.wall)} if train.exposures.wall else {}),
        "other_materials": [each._asdict() for each in matter.others],
        "timing_s": done.timing,
        "constants": [to_table(each) for each in done.constants],
        **({"verdict": done.verdict.as_dict()} if done.verdict else {}),
        **({"total": done.total.as_dict()} if done.total else {}),
    }


EXACT = Uncertain()
"""All constants of a scan are known."""


def config_of(
    scan: Scan,
    prior: MaterialPrior,
    method: Any,
    seed: int,
    matter: MatterKind | Literal["auto"],
    light: LightOptions,
    *,
    uncertain: Uncertain = EXACT,
    refine: PoseOptions | None = None,
) -> dict[str, Any]:
    """Entries of config.json that determine a run; method: its options, a dataclass with a `kind`."""
    return {
        "schema_version": SCHEMA,
        "method": to_table(method),
        "prior": prior.as_dict(),
        "matter": matter,
        "seed": seed,
        "scan_hash": scan_hash(scan),
        "light": to_table(light),
        "uncertain": to_table(uncertain),
        "refine": to_table(refine),
    }


def write_run(
    folder: RunFolder, done: Reconstruction, task: Task, fit: Running | None, entries: Mapping[str, Any]
) -> None:
    """Write object.h5, light.h5 where light is uneven, and summary.json with further `entries`.

    fit: the last one, if there was any.
    """
    write_object(folder.object, done.object, folder.marks())
    background = task.uneven and task.uneven.background
    if background is not None or done.still is not None:
        write_light(folder.light, background, done.still, folder.marks())
    folder.write_summary(summary_of(done, fit, task.scan) | dict(entries) | {"light": task.light_in_words})


@dataclass(frozen=True)
class Reconstruction:
    """What a method made of a scan.

    object: the matter, of any kind
    method: name of the method
    energy_kev: photon energy [keV] at which δ and β hold
    oversample: wave samples a pixel in the fit
    timing: seconds that each stage took
    finished: whether all stages came to their end
    choice: what was decided on the way, and which state `object` is
    delta_told: whether prior or frames determine δ; else β alone is known, and δ = β stands for it
    verdict: whether the training frames are explained; None for runs of versions that did not say
    total: the total δ by these frames, with its standard error; None likewise
    constants: what was known to a range only, or of continuous matter not at all, by the frames
    light: what is assumed of the light of other frames of the scan: smooth if that of the training frames is uneven
    geometry: where the frames were found to be; None: they are taken to be where the scan says
    still: [H, W] the light that all frames of the scan have in common, by those for training; None: there is none
    rest: the shape of moving bodies at rest; None: unknown
    """

    object: Stored
    method: str
    energy_kev: float
    oversample: int
    timing: dict[str, float]
    finished: bool
    choice: Choice = field(default_factory=Choice)
    delta_told: bool = True
    verdict: Verdict | None = None
    total: TotalMatter | None = None
    constants: tuple[Determined, ...] = ()
    light: LightOptions = EVEN
    geometry: Geometry | None = None
    still: np.ndarray | None = None
    rest: Rest | None = None

    @property
    def contents(self) -> Contents:
        """The quantities in files of its volume: δ only where it is determined."""
        return Contents.of(self.delta_told, self.energy_kev)

    def _repr_html_(self) -> str:
        """What Jupyter shows: what was decided and found, and the object."""
        rows = {"method": self.method, "finished": str(self.finished)}
        rows |= dict([beam_named(self.energy_kev)])
        rows["time"] = f"{sum(self.timing.values()):.1f} s"
        rows |= {"frames": " ".join(self.verdict.lines("training frames"))} if self.verdict else {}
        rows |= {"total": self.total.words} if self.total else {}
        return card("Reconstruction", rows) + "<br/>" + of_object(self.object)

    def placed(self, scan: Scan) -> Scan:
        """`scan`, as it was given to the reconstruction, at the distance and energy, or in the poses, that were
        found."""
        return placed(self.geometry.applied(scan) if self.geometry else scan, self.constants)


LENGTH_UNIT = "um"


def write_rest(folder: RunFolder, shape: TriangleMesh) -> None:
    """Write the mesh `shape` [m]."""
    write_mesh(folder.rest, shape, LENGTH_UNIT)


def read_rest(folder: RunFolder, found: Stored, config: dict[str, Any]) -> Rest | None:
    """What the run knows of the shape of its bodies `found` at rest; None where it knows nothing.

    config: what config.json holds. Errors: `InputError` for a mesh that is not of these bodies, and other damage.
    """
    if not (isinstance(found, MovingSurfaces) and folder.rest.is_file()):
        return None
    with as_written(folder.config, "what track wrote"):
        told = config["method"]["body"]  # None where red cells were found
        stiffness = KnownBody.stiffness if told is None else float(told["stiffness"])
    shape = read_meshes(folder.rest, LENGTH_UNIT)[0]
    own = [found.body(k)[1].numpy() for k in range(found.count)]
    fits = all(one.shape == shape.faces.shape and (one == shape.faces).all() for one in own)
    require(fits, f"{folder.rest} must have the triangles of the run's bodies, but it has others; bring back its own.")
    return Rest.of(shape, stiffness, found.unit_length)


def instants_of(folder: RunFolder) -> list[float]:
    """The times [s] of the frames that a run in motion was fitted to; empty for one that stands still."""
    folder.require_run()
    with as_written(folder.summary, "what track wrote"):
        return [float(time) for time in read_json(folder.summary).get("times_s", ())]


def chosen_frames(time_frame: int | Literal["all"] | None, times: list[float]) -> list[int]:
    """Numbers of the instants that `time_frame` names; without one, the first. Errors: `InputError` for others."""
    if time_frame == "all":
        return list(range(len(times)))
    frame = 0 if time_frame is None else time_frame
    last = len(times) - 1
    require(0 <= frame <= last, f"the run's instants are counted from 0 to {last}, but {frame} is asked for.")
    return [frame]


def reconstruction_at(done: Reconstruction, times: list[float], frame: int) -> Reconstruction:
    """`done` as it is at the instant `frame` (0 is the first) of `times` [s]: matter that stands still.

    Errors: `InputError` for an instant that the run does not have.
    """
    chosen_frames(frame, times)
    assert isinstance(done.object, InMotion)
    return replace(done, object=done.object.at(times[frame]))


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
        return read_geometry(folder.read_config().get("decided", {}))


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


def read_geometry(entries: Mapping[str, Any]) -> Geometry | None:
    """That of entries of a run's file; None where nothing was refined."""
    table = entries.get("geometry")
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
