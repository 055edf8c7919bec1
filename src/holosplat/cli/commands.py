"""Each command is a thin layer over the Python API: it reads files, calls one act, writes files, and prints."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import Positional, arg

from ..checks import InputError, require
from ..io.atomic import is_taken
from ..io.provenance import command_now
from ..io.reading import Reading
from ..ranges import Pixels, Seed, Weight, checked_dataclass
from .align import AS_SAID, RefineOptions
from .light import RunLightFlags
from .options import BeamlineOptions, MethodOptions, PriorOptions
from .places import Output
from .progress import ProgressBar
from .sentence import (
    INTERRUPTED,
    cut_off,
    interruptible,
    say,
    say_that_libraries_load,
    tell_frames,
    tell_reconstruction,
)
from .simulate import TruthOptions
from .view import LiveFlags, watched

if TYPE_CHECKING:
    from ..methods import Method
    from ..motion.flow_reconstruction import FlowOptions
    from ..series.plan import Settings
    from ..workflows.reconstruct import Reconstruction
    from ..workflows.verdict import Verdict


@checked_dataclass
class CarriedFlags:
    """How matter changes between the times of a scan."""

    motion: Literal["auto", "still", "each", "flow", "bodies"] | None = None
    """still: one object for all times; each: a run for each; flow: one object that a flow carries; bodies: closed
    bodies, as `track`; auto: by times set aside (default: one time)."""
    fading: Weight = 0.0
    """Expected standard deviation of the change of ln δ over all times, for matter that fades or grows denser (0:
    none); 0.3 is a change by about a third."""

    def applied(self, reading: Reading) -> Reading:
        """`reading` of the times that --motion needs. Errors: `InputError` where --time-frame is given, too."""
        if self.motion is None:
            return reading
        require(
            reading.part.time_frame is None,
            f"--motion {self.motion} takes all times, but --time-frame is {reading.part.time_frame}; leave one.",
        )
        taken = {"still": "still", "each": "each", "flow": "all"}.get(self.motion)
        return replace(reading, part=replace(reading.part, time_frame=taken))

    def options(self) -> FlowOptions:
        """The options of the method."""
        from ..motion.flow_reconstruction import FlowOptions

        return FlowOptions(fading=self.fading)


UNEXPLAINED = 3
"""Exit code of `reconstruct --strict` where frames are not explained."""


@dataclass(frozen=True)
class Asked:
    """What is asked of a reconstruction: what is known of the matter, method, light, geometry and motion."""

    matter: PriorOptions = field(default_factory=PriorOptions)
    how: MethodOptions = field(default_factory=MethodOptions)
    illumination: RunLightFlags = field(default_factory=RunLightFlags)
    geometry: RefineOptions = AS_SAID
    motion: CarriedFlags = field(default_factory=CarriedFlags)

    def each_time(self, method: Method, reading: Reading, seed: int) -> Settings:
        """What is done with each of several times; `InputError` for what one time alone can be asked."""
        from ..series.plan import Settings

        require(self.geometry.options() is None, "--refine is of one time; find the one geometry by holosplat align.")
        ranges = [*self.matter.ranges(), *reading.told.ranges()]
        named = self.motion.motion or "each"
        require(not ranges, f"--motion {named} needs one number for each constant; find it by reconstruct of one time.")
        shared = {"light": self.illumination.options(), "seed": seed}
        return Settings("reconstruct", method, self.how.kind_of_matter(), **shared)

    def ways(self, reading: Reading) -> dict[str, Any]:
        """What `workflows.reconstruct` takes by name; `InputError` for what does not go together."""
        from ..methods.uncertain import Uncertain

        refine = self.geometry.options()
        require(
            refine is None or reading.part.time_frame not in ("all", "still"),
            "--refine finds each frame by itself, but --motion flow has the same beams many times; find their one "
            "geometry with holosplat align, and reconstruct the file that it writes without --refine.",
        )
        uncertain = Uncertain(**reading.told.uncertain(), **self.matter.ranges())
        kind, light = self.how.kind_of_matter(), self.illumination.options()
        return {"matter": kind, "light": light, "uncertain": uncertain, "refine": refine}


def reconstruct(
    scan: Positional[Path],
    out: Output,
    asked: Annotated[Asked, arg(name="")] = Asked(),
    seed: Seed = 0,
    resume: bool = False,
    reading: Reading = Reading(),
    *,
    strict: bool = False,
    live: LiveFlags = LiveFlags(),
) -> None:
    """Reconstruct a scan, by what suits its matter or by a method of your choice, into a run folder.

    Args:
        scan: Scan: a file (NXtomo), or a folder (tiff, nerf-synthetic, r2-gaussian, or another run's).
        out: Run folder to make.
        seed: Seed of everything random.
        resume: Go on with an interrupted run; --resume RUN alone, with its scan and options.
        strict: Exit with 3 where the frames are not explained to within their noise; without it, that is a warning.
    """
    from ..io.formats import read_frames
    from ..methods.uncertain import Uncertain
    from ..planning.needs import Sizes, of_fit
    from ..planning.scan_facts import can_be_seen
    from ..workflows.reconstruct import reconstruct as fit
    from ..workflows.run_folder import RunFolder, claimed
    from .scans import scored, tell_found
    from .track import asks_for_motion, may_go_on, reconstruct_in_motion

    method, begun = asked.how.chosen(), asked.motion.applied(reading)
    by_time = asked.motion.motion in ("auto", "bodies") or begun.part.time_frame == "each"
    stray = by_time and (live.view or strict)
    require(not stray, "--view and --strict are of one time; leave them, or choose a time with --time-frame.")
    require(
        asked.motion.fading == 0 or begun.part.time_frame == "all",
        "--fading is of matter that a flow carries; name --motion flow (auto may choose another), or leave it.",
    )
    if asked.motion.motion == "auto":
        asked = _with_motion(scan, out, asked, reading, seed, resume)
    reading = asked.motion.applied(reading)
    if asked.motion.motion == "bodies" or reading.part.time_frame == "each":
        _time_by_time(scan, out, asked, reading, seed, resume)
        return
    if method.of_series and reading.part.time_frame == "all":
        reading = replace(reading, part=replace(reading.part, time_frame=None))
    ways, folder = asked.ways(reading), RunFolder(out)
    measured = read_frames(scan, replace(reading, told=reading.told.at_middle()))
    prior = asked.matter.without_ranges().prior(measured.exposures.reference_energy, reading.told.wall)
    measured = measured.in_memory() if can_be_seen(measured) else measured
    seen = measured.exposures[~measured.is_test]
    if method.of_series:
        tell_frames(method.kind, seen, out, lambda frames: of_fit(Sizes.of(frames), method))
    elif not measured.is_series:
        tell_reconstruction(measured, out, method, prior, ways["matter"], ways["refine"] is not None)
    measured = measured.in_memory()
    plain = may_go_on(folder, resume) and ways["refine"] is None and ways["uncertain"] == Uncertain()
    if asks_for_motion(reading, method, ways["matter"], plain):
        require(not live.view, "--view shows fits of one time; choose it with --time-frame, or leave --view.")
        with claimed(folder):
            told = (seed, ways["light"], asked.motion.options())
            if reconstruct_in_motion(scan, reading, prior, folder, told, resume=resume):
                return
    with claimed(folder):
        kept = interruptible(lambda: cut_off(folder))
        with kept, ProgressBar() as bar, watched(live, out.name, bar.show) as follow:
            told = {"on_progress": follow.on_progress, "on_state": follow.on_state}
            result = fit(measured, prior, method, seed, folder=folder, resume=resume, **ways, **told)
        report, held_out = scored(folder, result, measured, scan, reading)
    tell_found(folder, result, report)
    if reading.part.time_frame == "still" and result.verdict is not None and not result.verdict.good:
        say("all times were taken for one object that stands still; if it moves, name another --motion, such as each")
    _end(result, out, strict, held_out)


def _with_motion(scan: Path, out: Path, asked: Asked, reading: Reading, seed: int, resume: bool) -> Asked:
    """What is asked, with the motion that frames choose, or have chosen for what is begun in `out`."""
    from ..io.formats import read_frames
    from ..workflows.motion_choice import MOTION, begun_motion, choose_motion, motion_named

    settings = asked.each_time(asked.how.chosen(), reading, seed)
    decision = begun_motion(out) if resume else None
    if decision is None:
        require(
            not (resume and is_taken(out)),
            f"--motion auto goes on with what it has begun, but {out} was begun without it; name the --motion of that.",
        )
        measured = read_frames(scan, reading).in_memory()
        prior = asked.matter.prior(measured.exposures.reference_energy, reading.told.wall)
        with interruptible(lambda: "interrupted before the motion was chosen"), ProgressBar() as bar:
            how = {"light": settings.light, "matter": settings.matter, "on_progress": bar.show}
            decision = choose_motion(measured, prior, settings.method, seed, **how)
        if command := command_now():
            command.decided[MOTION] = decision.as_dict()
    say(decision.line)
    return replace(asked, motion=replace(asked.motion, motion=motion_named(decision.choice)))


def _time_by_time(scan: Path, out: Path, asked: Asked, reading: Reading, seed: int, resume: bool) -> None:
    """Bodies followed through all times, or a run for each time."""
    from ..methods import Auto
    from .series import reconstruct_each
    from .track import track

    method = asked.how.chosen()
    if asked.motion.motion == "bodies":
        stray = {"--refine": asked.geometry.options() is not None}
        stray |= {"--method": not isinstance(method, Auto), "--matter": asked.how.kind_of_matter() is not None}
        for name, given in stray.items():
            require(not given, f"--motion bodies follows closed bodies through all times; leave {name}.")
        track(scan, out, asked.matter, seed=seed, resume=resume, reading=reading, illumination=asked.illumination)
    else:
        reconstruct_each(scan, out, asked.each_time(method, reading, seed), asked.matter.prior, reading, resume)


def _end(result: Reconstruction, out: Path, strict: bool, held_out: Verdict | None) -> None:
    """Warn of what is not explained or not finished; exit with 3 or 130 where that is so of the training frames."""
    unexplained = result.verdict is not None and not result.verdict.good
    if unexplained:
        say("warning: the frames are not explained; do not trust the volume before the cause is found")
    elif held_out is not None and not held_out.good:
        say("warning: held-out frames are not explained, only those of the fit; do not trust the volume between these")
    if not result.finished:
        say(f"interrupted, but {out} is usable; go on with --resume")
        raise SystemExit(INTERRUPTED)
    if strict and unexplained:
        raise SystemExit(UNEXPLAINED)


def render(
    run: Positional[Path],
    scan: Path,
    out: Output,
    split: Literal["test", "train", "all"] = "test",
    reading: Reading = Reading(),
) -> None:
    """Predict the frames of a scan from a run.

    Args:
        run: Run folder.
        scan: Scan whose poses and optics are rendered.
        out: Scan file to write: the predicted frames, in the scan's order.
        split: Which frames.
    """
    from .scans import predict

    predict(run, scan, out, split, reading)


def evaluate(
    run: Positional[Path],
    scan: Path | None = None,
    truth: Path | None = None,
    as_json: Annotated[bool, arg(name="json")] = False,
    reading: Reading = Reading(),
) -> None:
    """Score a run on held-out frames and against the true volume, which then joins its report.

    A run of track is scored on the frames of all its times, and on the volume of the first; with --time-frame at one.

    Args:
        run: Run folder.
        scan: Scan (default: the one that was reconstructed).
        truth: Volume file of the truth, of any format that export --volume writes.
        as_json: Print JSON instead of a table.
    """
    say_that_libraries_load()
    from .scans import judge

    judge(run, scan, truth, as_json, reading)


@checked_dataclass
class ObjectFiles:
    """The object of a run as it is, not its volume."""

    compact: Output | None = None
    """File several times smaller than the run's, of rounded numbers (HDF5); of a run of track, of all times."""
    step_px: Pixels = 1 / 32
    """Step of places in it [pixels]; those of sizes, orientations and amplitudes go with it."""
    together: tuple[Path, ...] = ()
    """More runs of a series, in order, for the same file of --compact, which stores once what they have in common."""
    splats: Output | None = None
    """PLY file of splat viewers (µm), of a run of Gaussians; their opacity is no phase (docs/export.md)."""


def export(
    run: Positional[Path],
    volume: Output | None = None,
    shape: tuple[int, int, int] | None = None,
    voxel_size: float | None = None,
    bodies: Output | None = None,
    time_frame: int | Literal["all"] | None = None,
    objects: ObjectFiles = ObjectFiles(),
) -> None:
    """Write δ and β of a run as a volume, its bodies as meshes, or its object in few bytes or as splats.

    Args:
        run: Run folder, or the folder of a series of single times.
        volume: Volume to write, by its suffix: .h5 or .hdf5, HDF5; .vti, for ParaView and PyVista; .nrrd, for 3D Slicer
            and ITK; .mrc, for ChimeraX; .tif or .tiff, an OME-TIFF; .zarr, a folder of OME-Zarr (extra zarr). NRRD and
            MRC hold δ alone, and β in NAME.beta.nrrd or NAME.beta.mrc. Of absorption alone µ [1/m] stands in δ's place.
            HDF5 also holds /views, the number of training views that show each voxel, if the run's scan is there; and
            of a rehearsed run /matter, the probability that a voxel is matter.
        shape: Voxels along z, y, x (default: the scan's field of view, Z = X = W, Y = H).
        voxel_size: Edge of a voxel [m] (default: the pixel size).
        bodies: Of a run of surfaces: a folder to make, with one VTK file a body (µm), the largest first, or of a run
            of track the same body under the same name at all times; or by its suffix one file of all bodies, .vtu
            (VTK, µm), .stl (µm) or .glb (glTF, m).
        time_frame: Of a series, and of a run of track: the time, counted from 0 (default: the first), or all, to files
            and folders whose names end with _t0000 and so on, or of track to one .glb in which the bodies move. Beside
            HDF5 a .xdmf, beside .vti and .vtu a .pvd opens all times in ParaView.
    """
    from .export import write_files

    require(
        any((volume, bodies, objects.compact, objects.splats)),
        "export needs --volume, --bodies, --compact or --splats; name what to write.",
    )
    require(objects.compact is not None or not objects.together, "--together needs --compact; name its file.")
    files = {"volume": volume, "bodies": bodies, "compact": objects.compact, "splats": objects.splats}
    write_files(run, files, (shape, voxel_size), time_frame, objects.step_px, objects.together)


def demo(out: Output = Path("demo")) -> None:
    """Run the whole chain on generated red cells: simulate, reconstruct, evaluate, report.

    Args:
        out: Folder to make.
    """
    from ..workflows.demo import DETECTOR, write_demo_meshes
    from .simulate import simulate

    meshes, scan, truth, run = out / "meshes", out / "scan.nxs", out / "truth.h5", out / "run"
    meshes.mkdir(parents=True)
    paths = write_demo_meshes(meshes)
    say(f"wrote {len(paths)} generated red cells to {meshes}")
    detector = "--detector {} {}".format(*DETECTOR)
    say(f"\n$ holosplat simulate {meshes}/*.vtk {detector} --views 16 --psf-sigma-px 0.05 --out {scan} --truth {truth}")
    beamline = BeamlineOptions(detector=DETECTOR, psf_sigma_px=0.05, views=16)
    simulate(tuple(paths), beamline=beamline, out=scan, truth=TruthOptions(truth))
    say(f"\n$ holosplat reconstruct {scan} --material haemoglobin --out {run}")
    reconstruct(scan, run, Asked(PriorOptions(("haemoglobin",))))
    say(f"\n$ holosplat evaluate {run} --truth {truth}")
    evaluate(run, truth=truth)


def backends() -> None:
    """Say which backends can be used here, and what each of them offers."""
    from ..backends import DESCRIPTIONS, device_name, missing, resolve, support_table

    for name, description in DESCRIPTIONS.items():
        reason = missing(name)
        state = f"not usable here: {reason}" if reason else f"usable ({device_name(name)})"
        print(f"{name:10} {description}; {state}")
    try:
        print(f"auto       would take {resolve('auto')}\n")
    except InputError:
        print("auto       finds neither cpu nor cuda\n")
    table = [["", *DESCRIPTIONS], *support_table()]
    widths = [max(map(len, column)) + 2 for column in zip(*table)]
    for row in table:
        print("".join(cell.ljust(width) for cell, width in zip(row, widths)).rstrip())
