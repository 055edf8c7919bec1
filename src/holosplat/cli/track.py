"""`holosplat track | surface`: closed bodies through the times of a scan, and those of a run as fitted surfaces."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from tyro.conf import Positional

from ..bodies.rest_shape import KnownBody
from ..checks import positive, require
from ..io.atomic import atomic_folder, write_json
from ..io.formats import read_frames, read_volume_file, run_source
from ..io.reading import Reading
from ..io.vtk import write_mesh
from ..matter import KnownSeveral, MaterialPrior, MatterKind
from ..mesh import TriangleMesh
from ..methods import Method
from ..methods.surface_fit import SurfaceOptions, oversampling
from ..methods.surfaces import refine_surfaces
from ..motion.flow_reconstruction import FlowOptions
from ..motion.known import beam_directions
from ..motion.track import TrackOptions
from ..optics.background import LightOptions
from ..planning.acts import of_motion, of_surfaces, of_track
from ..ranges import Metres, Seed, Share, Weight, checked_dataclass
from ..representations import MovingSurfaces
from ..scan import Scan
from ..tables import with_entries
from ..units import number_of
from ..workflows.evaluate import TIMES, Evaluation, score_object, write_times
from ..workflows.evaluate import evaluate as score
from ..workflows.forecast import read_forecast
from ..workflows.motion_choice import may_flow
from ..workflows.provenance import scan_hash
from ..workflows.reconstruct import load_reconstruction
from ..workflows.reconstruction import Reconstruction, instants_of
from ..workflows.run_folder import RunFolder, claimed
from ..workflows.track import BODIES, COLLECTION, TRACKS, begun_in_motion, reconstruct_moving
from ..workflows.track import track as follow
from .light import LightFlags
from .options import PriorOptions
from .places import Output
from .progress import ProgressBar
from .scans import report_of_middle, report_run, run_and_scan
from .sentence import cut_off, interruptible, put, say, tell_frames, tell_result


@checked_dataclass
class BodyFlags:
    """What is known of the bodies' shape."""

    body: str = ""
    """Shape at rest of all bodies: red-cell, or a file of one closed mesh (.stl, .ply, .obj, .vtk, .vtp, .vtu)."""
    body_unit: str = "um"
    """Unit of the mesh file's coordinates."""
    body_size: Metres = 0.0
    """Largest extent at rest [m] (0: a red cell's 7.82 µm, or the file's)."""
    body_uncertain: Share = 0.1
    """By which part all bodies may be larger or smaller than that, at most."""
    body_stiffness: Weight = 100.0
    """Minus the logarithm of the probability of strains of about one."""

    def known(self) -> KnownBody | None:
        """None without a shape."""
        if not self.body:
            return None
        return KnownBody(self.body, self.body_unit, self.body_size, self.body_uncertain, self.body_stiffness)


@checked_dataclass
class MotionFlags:
    """How bodies are found and move."""

    degree: int = 2
    """Degree of the paths' polynomials."""
    pieces: int = 0
    """Pieces of the paths' splines over the whole time (0: as many as predict held-out frames best)."""
    rounds: int = 4
    """How often bodies are looked for beside those that are known, at most."""
    learned: bool = True
    """Find bodies of single times by the package's network, if frames do not contradict it and its bodies explain
    clearly more (red cells in two or three beams)."""
    cells: bool = True
    """In two beams, also follow the network's bodies as red cells of known shape; kept unless bodies of any shape fit
    clearly better."""
    least_volume: float = 30.0
    """Bodies of fewer voxels, of a pixel's edge, are not followed."""
    volume_kept: Weight = 0.006
    """Standard deviation of a body's volume over time, as a share (0: volumes are free)."""
    area_kept: Weight = 0.03
    """The same of its area (0: areas are free)."""
    apart: Weight = 0.2
    """How deep bodies may lie in each other, a standard deviation in pixels (0: as they like)."""
    acceleration: Weight = 0.4
    """Standard deviation of a body's acceleration, in pixels per squared length of a piece (0: paths are free)."""
    curvature: Weight = 3.0
    """Prior of smooth shapes, as `[fit] curvature` of surfaces (0: free)."""
    twins: bool = True
    """Bodies of known shape in two beams are told from others whose shadows have the same size and tilt, by fits."""
    intervals: bool = True
    """Standard errors from fits to halves of the frames, which take about as long as the last fit."""
    effort: float = 1.0
    """Factor of the numbers of steps."""

    def options(self) -> TrackOptions:
        """The options of the method."""
        named = {name: value for name, value in vars(self).items() if name not in ("effort", "learned", "cells")}
        usual = TrackOptions().with_effort(positive("--effort", self.effort))
        usual = replace(usual, cells=self.cells, learned=usual.learned if self.learned else None)
        return with_entries(usual, named)


def track(
    scan: Positional[Path],
    out: Output,
    matter: PriorOptions = PriorOptions(),
    how: MotionFlags = MotionFlags(),
    seed: Seed = 0,
    resume: bool = False,
    reading: Reading = Reading(),
    *,
    after: Path | None = None,
    illumination: LightFlags = LightFlags(),
    known: BodyFlags = BodyFlags(),
) -> None:
    """Follow closed bodies through the times of a scan: their shapes on smooth paths, into a run folder.

    Args:
        scan: Scan of several times: a file (NXtomo), or a folder.
        out: Run folder to make: bodies.pvd with one VTK file a body and time (µm), tracks.csv, and what reconstruct
            writes.
        seed: Seed of everything random.
        resume: Go on with an interrupted run; --resume RUN alone, with its scan and options.
        after: Folder that holosplat forecast wrote, of an earlier run that reaches over these times: its bodies are
            the start, and its standard errors the prior.
    """
    require(
        reading.part.time_frame is None,
        f"bodies are followed through all times, but --time-frame is {reading.part.time_frame}; leave it.",
    )
    options, folder = replace(how.options(), body=known.known()), RunFolder(out)
    before = None if after is None else read_forecast(RunFolder(after))
    measured = read_frames(scan, reading)
    tell_frames("track", measured.exposures[~measured.is_test], out, lambda seen: of_track(seen, options))
    measured = measured.in_memory()
    if before is None and options.body is None and len(beam_directions(measured.train().views)) == 2:
        say(
            "note: two beams leave the shapes of bodies open; where their shape at rest is known, --body red-cell or "
            "--body FILE helps."
        )
    prior = matter.prior(measured.exposures.reference_energy, reading.told.wall)
    with interruptible(lambda: cut_off(folder)), ProgressBar() as bar:
        told = {"light": illumination.options(), "folder": folder, "resume": resume, "on_progress": bar.show}
        told |= {"after": before}
        result = follow(measured, prior, options, seed, **told)
    with claimed(folder):
        evaluation = _scored(folder, result, measured, scan, reading)
        report = report_run(folder, result, measured, evaluation, None)
    put((*evaluation.lines(), *result.choice.lines()))
    tell_result(folder, result, report)
    say(f"wrote {out / COLLECTION} ({BODIES}/), {out / TRACKS}")


def _scored(folder: RunFolder, result: Reconstruction, measured: Scan, scan: Path, reading: Reading) -> Evaluation:
    """Score a run of several times, and write to its folder the source of its frames and the verdict on each time."""
    folder.write_source(run_source(scan, reading))
    evaluation = score(result, measured, None)
    write_times(folder.path / TIMES, result, measured, evaluation.light)
    return evaluation


FEWEST_TIMES = 3
"""Times from which on matter in motion can be found."""


def asks_for_motion(reading: Reading, method: Method, matter: MatterKind | None, plain: bool) -> bool:
    """Whether --motion flow looks for motion: nothing says the method, levels of matter, or anything else (`plain`)."""
    return reading.part.time_frame == "all" and may_flow(method, matter) and plain


def may_go_on(folder: RunFolder, resume: bool) -> bool:
    """Whether a run in motion may be in `folder`, or begin there; not where one of another kind is to go on."""
    return not resume or not folder.config.is_file() or begun_in_motion(folder)


def reconstruct_in_motion(
    scan: Path,
    reading: Reading,
    prior: MaterialPrior,
    folder: RunFolder,
    how: tuple[int, LightOptions, FlowOptions],
    *,
    resume: bool = False,
) -> bool:
    """Find matter in motion, and write its run, report and scores; False where nothing moves, or times are few. how:
    the seed, what is assumed of the light, and how matter moves."""
    seed, light, options = how
    reading = replace(reading, part=replace(reading.part, time_frame=None))
    planned = read_frames(scan, replace(reading, told=reading.told.at_middle()))
    train = planned.exposures[~planned.is_test]
    count = len(np.unique(train.time))
    if isinstance(prior, KnownSeveral):
        return _still("a flow carries one material, but several are known, and motion is not asked of the frames")
    if count < FEWEST_TIMES:
        return _still(f"motion is asked of frames of {FEWEST_TIMES} times or more, but there are {count}")
    tell_frames("matter in motion", train, folder.path, lambda seen: of_motion(seen, options))
    measured = planned.in_memory()
    with interruptible(lambda: cut_off(folder)), ProgressBar() as bar:
        told = {"light": light, "folder": folder, "resume": resume, "on_progress": bar.show}
        found = reconstruct_moving(measured, prior, options, seed, **told)
    if found is None:
        return _still("nothing moves, as far as the frames tell")
    result = found.reconstruction
    evaluation = _scored(folder, result, measured, scan, reading)
    report = report_of_middle(folder, result, measured)
    put(evaluation.lines())
    for line in (*found.history, *(each.line for each in result.choice.decisions)):
        say(line)
    tell_result(folder, result, report)
    return True


def _still(why: str) -> bool:
    say(f"{why}: they are taken as of one time")
    return False


LENGTH_UNIT = "um"


def surface(
    run: Positional[Path],
    out: Output,
    scan: Path | None = None,
    truth: Path | None = None,
    how: SurfaceOptions = SurfaceOptions(),
    reading: Reading = Reading(),
) -> None:
    """Cut the bodies of a run out as closed surfaces, fit these to the frames, and write them as VTK files (µm).

    Args:
        run: Run folder, of a reconstruction as one material: any but those that fit δ and β apart. Of a run of track,
            --time-frame says at which time; bodies keep their names.
        out: Folder to make: body000.vtk …, the largest first, each with its cavities, and summary.json.
        scan: Scan (default: the one that was reconstructed).
        truth: Volume file of the truth, to score both against.
    """
    folder = RunFolder(run)
    folder.require_run()
    times = instants_of(folder)
    require(
        not times or isinstance(reading.part.time_frame, int),
        f"{run} holds bodies in motion, whose surfaces are fitted at one time; choose it with --time-frame 0 … "
        f"{len(times) - 1}, or write the bodies as they are with export --bodies.",
    )
    (result, measured), volume = run_and_scan(folder, scan, reading), read_volume_file(truth) if truth else None
    name = "Gaussians" if result.object.kind == "gaussians" else "run"
    if not times and not folder.is_of(scan_hash(measured)):
        say("this is not the scan that was reconstructed: its held-out frames may have been fitted")
    if folder.read_config().get("prior", {}).get("kind") == "free":
        known = "δ and β" if result.delta_told else "β"
        say(f"nothing was known of the matter: {known} of the surfaces are what the run estimated")
    train = measured.exposures[~measured.is_test]
    tell_frames("surface", train, out, lambda seen: of_surfaces(seen, how))
    before = score(result, measured, volume)
    began = time.perf_counter()
    with ProgressBar() as bar:
        found = refine_surfaces(result.object, measured, how, lambda *now: bar.show(now[0], now[1], {}))
    seconds = time.perf_counter() - began
    after = score_object(found, measured, volume, oversampling(measured.train(), how.fit))
    said = {"seconds": seconds, "settings": asdict(how), name.lower(): before.as_dict(), "surfaces": after.as_dict()}
    whole = load_reconstruction(folder).object
    bodies = whole.parted(found.vertices.detach().cpu()) if isinstance(whole, MovingSurfaces) else found.bodies()
    constants = result.contents.of_matter(found.matter)  # of one material, for which surfaces are refined
    write_bodies(out, bodies, [constants] * len(bodies), said)
    for of, scores in ((name, before), ("surfaces", after)):
        print(f"{of}:", *scores.lines(), sep="\n  ")
    say(f"wrote {out}: {number_of(len(bodies), 'body')} of {len(found.faces)} triangles, {seconds:.1f} s")


def write_bodies(
    out: Path, bodies: Sequence[TriangleMesh], constants: Sequence[Mapping[str, float]], said: Mapping[str, Any]
) -> None:
    """Write one VTK file a body (µm), and summary.json of sizes, `constants` of the matter, and what is `said`."""
    one = all(each == constants[0] for each in constants)
    with atomic_folder(out) as temporary:
        for body in bodies:
            write_mesh(temporary / f"{body.name}.vtk", body, LENGTH_UNIT)
        sizes = {body.name: {"triangles": len(body.faces), "volume_m3": body.volume} for body in bodies}
        about: dict[str, Any] = {"bodies": sizes, "length_unit": LENGTH_UNIT}
        if one:
            about["material"] = dict(constants[0])
        else:
            about["materials"] = {body.name: dict(each) for body, each in zip(bodies, constants)}
        write_json(temporary / "summary.json", {**about, **said})
