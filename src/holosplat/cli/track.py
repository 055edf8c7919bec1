"""`holosplat track`: closed bodies through the times of a scan, and the options of their known shape."""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path

from tyro.conf import Positional

from ..bodies.rest_shape import KnownBody
from ..checks import positive, require
from ..io.formats import read_frames, run_source
from ..io.reading import Reading
from ..motion.known import beam_directions
from ..motion.track import TrackOptions
from ..planning.acts import of_track
from ..ranges import Metres, Seed, Share, Weight, ranged
from ..report.run import report_run
from ..workflows.evaluate import evaluate as score
from ..workflows.run_folder import RunFolder, claimed
from ..workflows.track import BODIES, COLLECTION, TRACKS
from ..workflows.track import track as follow
from .light import LightFlags
from .options import PriorOptions
from .places import Output
from .progress import INTERRUPTED, ProgressBar
from .room import tell_frames


@dataclass(frozen=True)
@ranged
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


@dataclass(frozen=True)
@ranged
class MotionFlags:
    """How bodies are found and move."""

    degree: int = 2
    """Degree of the paths' polynomials."""
    pieces: int = 0
    """Pieces of the paths' splines over the whole time (0: as many as predict held-out frames best)."""
    rounds: int = 4
    """How often bodies are looked for beside those that are known, at most."""
    learned: bool = True
    """Bodies of single times are found in what the package's network guesses, where frames do not contradict it and its
    bodies explain clearly more: red cells in two or three beams."""
    cells: bool = True
    """In two beams, bodies that the network guesses are followed as red cells, too, by their shape at rest; these are
    kept unless bodies of any shape leave clearly less of the frames."""
    least_volume: float = 30.0
    """Bodies of fewer voxels, of a pixel's edge, are not followed."""
    volume_kept: Weight = 0.006
    """Standard deviation of a body's volume over time, as a share (0: volumes are free)."""
    area_kept: Weight = 0.03
    """The same of its area (0: areas are free)."""
    apart: Weight = 0.2
    """How deep bodies may lie in each other, a standard deviation in pixels (0: as they like)."""
    acceleration: float = 1e-6
    """Weight of bent paths (0: as bent as splines can be)."""
    bending: float = 1.0
    """Weight of bent surfaces (0: free)."""
    twins: bool = True
    """Bodies of known shape in two beams are told from others whose shadows have the same size and tilt, by fits."""
    intervals: bool = True
    """Standard errors from fits to halves of the frames, which take about as long as the last fit."""
    effort: float = 1.0
    """Factor of the numbers of steps."""

    def options(self) -> TrackOptions:
        """The options of the method."""
        usual = TrackOptions().with_effort(positive("--effort", self.effort))
        paths = replace(usual.paths, degree=self.degree, pieces=self.pieces)
        found = replace(usual.sightings, least_volume=self.least_volume)
        known = {name: getattr(self, name) for name in ("volume_kept", "area_kept", "apart", "acceleration")}
        fits = {
            name: replace(fit, objective=replace(fit.objective, bending=self.bending), **known)
            for name, fit in (("stiff", usual.stiff), ("soft", usual.soft), ("half", usual.half))
        }
        usual = usual if self.learned else replace(usual, learned=None)
        return replace(
            usual,
            paths=paths,
            sightings=found,
            rounds=self.rounds,
            twins=self.twins,
            cells=self.cells,
            intervals=self.intervals,
            **fits,
        )


USUAL = MotionFlags()
"""As the method has it."""
LIGHT = LightFlags()
"""Even, unless the air of frames says otherwise."""
UNKNOWN = BodyFlags()
"""Nothing."""


def track(
    scan: Positional[Path],
    out: Output,
    matter: PriorOptions = PriorOptions(),
    how: MotionFlags = USUAL,
    seed: Seed = 0,
    resume: bool = False,
    reading: Reading = Reading(),
    *,
    illumination: LightFlags = LIGHT,
    known: BodyFlags = UNKNOWN,
) -> None:
    """Follow closed bodies through the times of a scan: their shapes on smooth paths, into a run folder.

    Args:
        scan: Scan of several times: a file (NXtomo), or a folder.
        out: Run folder to make: bodies.pvd with one VTK file a body and time (µm), tracks.csv, and what reconstruct
            writes.
        seed: Seed of everything random.
        resume: Go on with an interrupted run; --resume RUN alone, with its scan and options.
    """
    require(
        reading.part.time_frame is None,
        f"bodies are followed through all times, but --time-frame is {reading.part.time_frame}; leave it.",
    )
    options, folder = replace(how.options(), body=known.known()), RunFolder(out)
    measured = read_frames(scan, reading)
    tell_frames("track", measured.exposures[~measured.is_test], out, lambda seen: of_track(seen, options))
    measured = measured.in_memory()
    if options.body is None and len(beam_directions(measured.train().views)) == 2:
        print(
            "note: two beams leave the shapes of bodies open; where their shape at rest is known, --body red-cell or "
            "--body FILE helps.",
            file=sys.stderr,
        )
    prior = matter.prior(measured.exposures.reference_energy)
    try:
        with ProgressBar() as bar:
            result = follow(
                measured,
                prior,
                options,
                seed,
                light=illumination.options(),
                folder=folder,
                resume=resume,
                on_progress=bar.show,
            )
    except KeyboardInterrupt:
        begun = folder.checkpoint.is_file()
        print(f"interrupted{f'; go on with --out {out} --resume' if begun else ''}", file=sys.stderr)
        raise SystemExit(INTERRUPTED) from None
    with claimed(folder):
        folder.write_source(run_source(scan, reading))
        evaluation = score(result, measured, None)
        report = report_run(folder, result, measured, evaluation, None)
    for line in (*evaluation.lines(), *result.choice.lines()):
        print(line)
    for line in result.verdict.lines("training frames") if result.verdict else ():
        print(line)
    seconds = sum(result.timing.values())
    print(f"{seconds:.1f} s, {result.object.described}; report: {report}", file=sys.stderr)
    print(f"wrote {out / COLLECTION} ({BODIES}/), {out / TRACKS}", file=sys.stderr)
