"""`holosplat track`: closed bodies through the times of a scan."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

from tyro.conf import Positional

from ..checks import require
from ..io.formats import read_frames
from ..io.reading import Reading
from ..io.run_scan import run_source
from ..motion.known import beam_directions
from ..planning.acts import of_track
from ..ranges import Seed
from ..report.run import report_run
from ..workflows.evaluate import evaluate as score
from ..workflows.run_folder import RunFolder, claimed
from ..workflows.track import BODIES, COLLECTION, TRACKS
from ..workflows.track import track as follow
from .bodies import BodyFlags, MotionFlags
from .light import LightFlags
from .options import PriorOptions
from .places import Output
from .progress import INTERRUPTED, ProgressBar
from .room import tell_frames

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
