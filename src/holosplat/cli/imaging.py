"""`holosplat grow | record | correct | join`: cells in the flow through a channel, camera and pulses, flat fields, and
beams brought together."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from tyro.conf import Positional

from ..beamline.grow import Growth, SeriesFolder
from ..beamline.grow import grow as grow_cells
from ..beamline.record import RecordingOptions
from ..beamline.record import record as record_file
from ..io.lock import sole_writer
from ..io.reading import Part, Reading
from ..optics.camera import Camera, Illumination
from ..optics.resampling import Flip
from ..planning.acts import of_growth
from ..planning.needs import Needs
from ..specimens.membrane.rest import nodes_of
from ..units import in_percent, number_of, span
from ..workflows.correct import FAR, Corrected, CorrectionOptions
from ..workflows.correct import correct as correct_file
from ..workflows.join import join as join_files
from .places import Output
from .progress import ProgressBar
from .sentence import interruptible, say, tell

OFF = 0.02
"""How far air may be off 1 before it is warned of."""


def record(
    scan: Positional[Path],
    out: Output,
    what: RecordingOptions,
    camera: Camera,
    light: Illumination,
    truth: Output | None = None,
    part: Part = Part(),
) -> None:
    """Record a noise-free scan as raw counts: pulses of a free-electron laser, a camera, flats and darks.

    Args:
        scan: Scan of relative intensities without noise, such as `holosplat simulate` writes.
        out: File of raw counts to write (NXtomo with image_key).
        truth: Also write what the frames do not say: light, pulse energies, gains and defects (HDF5).
    """
    with ProgressBar() as bar:
        done = record_file(scan, out, what, camera, light, truth, on_progress=bar.of("recording frames"), part=part)
    say(
        f"wrote {out}: {number_of(done.projections, 'projection')}, {number_of(done.flats, 'flat')} and "
        f"{number_of(done.darks, 'dark')}, {camera.bits} bits, {done.gain:.4g} counts a photon, "
        f"{number_of(done.defects, 'defective pixel')}"
    )
    if done.saturated > 0:
        say(f"warning: {done.saturated:.2%} of the projections' good pixels are saturated; lower --gain or the photons")
    if truth is not None:
        say(f"wrote {truth}: what the frames do not say")


def correct(raw: Positional[Path], out: Output, how: CorrectionOptions, reading: Reading = Reading()) -> None:
    """Correct raw counts by dark and flat fields into a scan of relative intensities.

    Args:
        raw: File of raw counts (NXtomo with image_key).
        out: Scan file to write (NXtomo).
    """
    with ProgressBar() as bar:
        done = correct_file(raw, out, how, bar.of("correcting frames"), reading)
    fields = f"flat fields of {number_of(done.components, 'component')}"
    flat = fields if done.method == "dynamic" else "the mean flat field"
    say(f"wrote {out}: {number_of(done.frames, 'frame')} by {flat}, normalised: {done.normalised}")
    say(_levels(done, how.normalise is not None or bool(how.air)))
    if how.method is None and done.method == "plain":
        say(f"method plain, for the dynamic one needs three flats, and the file has {done.flats}")
    if done.rings:
        say(f"rings: a pattern of {done.rings:.2%} (rms) that all frames had in common was divided out")
    if done.airless:
        say(f"{done.airless} of the frames show no air; they were divided by the mean light of the others")
    say(f"filled defective pixels from their neighbours: {done.marked} marked in the file, {done.found} found beside")


def _levels(done: Corrected, is_asked: bool) -> str:
    """What frames were divided by, and how bright their air is then; is_asked: whether --normalise or --air says so."""
    low, high = done.divided
    what = {"air": "the light in its air", "mean": "its own mean", "rim": "the mean of its rim"}.get(done.normalised)
    said = [f"each frame was divided by {what}, {span(np.array([low, high]))}" if what else "light was not normalised"]
    wrong = []
    if done.air is not None:
        said.insert(0, f"air is {done.air:.3f} of the flat field")
    else:
        said.append("no air was found to check it by (give boxes of it by --air)")
    if done.air is not None and abs(done.air - 1) > OFF:
        wrong.append("air must be 1: take --normalise air, and see whether flats and darks are those of the frames")
        if not is_asked and not what:
            wrong.append("if no air is there, for matter fills the frames, they are right as they are")
    if done.normalised == "mean" and done.air is None:
        wrong.append("what all of a frame absorbs is lost; take --normalise none if flats had the same light")
    if not is_asked and what and (high < 1 - FAR or low > 1 + FAR):
        wrong.append("if matter fills the frames, this was its absorption, and --normalise none keeps it")
    return ("warning: " if wrong else "") + "; ".join([*said, *wrong])


def join(
    scans: Positional[tuple[Path, ...]],
    out: Output,
    pixel_size: float | None = None,
    flip: tuple[Flip, ...] = (),
    part: Part = Part(),
    exposures: Path | None = None,
) -> None:
    """Join scans of several beams, one file each; pixel sizes, energies and distances may differ.

    Args:
        scans: Scans, one a beam, with as many pixels each; else give --crop or --pixel-size.
        out: Scan file to write.
        pixel_size: Bring all frames to pixels of this size [m] (default: each file keeps its own).
        flip: What each detector saw reversed, one word a file (default: what the files say themselves).
        exposures: Where the frames are, in their order (geometry.toml of align or calibrate), whatever the files say.
    """
    with ProgressBar() as bar:
        joined = join_files(scans, out, pixel_size, flip, bar.of("joining frames"), part, exposures)
    rows, columns = joined.views.shape
    frames, pixel = number_of(len(joined), "frame"), span(1e6 * joined.views.pixel_sizes)
    say(f"wrote {out}: {frames} of {rows} × {columns} pixels of {pixel} µm")


def grow(out: Output, what: Growth, resume: bool = False) -> None:
    """Let red cells flow through a channel, and write their meshes (VTK, µm) at every snapshot.

    Args:
        out: Folder to make: rbcCC_TTT.vtp for cell CC at snapshot TTT, and cells.pvd, which ParaView opens.
        resume: Go on with an interrupted run, or to more snapshots; --resume FOLDER alone, with its options.
    """
    what.check()
    coarser = ((f"--frequency {f}", _needs(replace(what, frequency=f))) for f in range(what.frequency - 1, 2, -1))
    tell("grow", _needs(what), out, coarser)
    with interruptible(lambda: _cut_off(SeriesFolder(out))), sole_writer(out), ProgressBar() as bar:
        grown = grow_cells(what, out, resume, bar.of("cells in flow"))
    wrote = out if what.compact else SeriesFolder(out).collection
    say(
        f"wrote {wrote}: {number_of(grown.snapshots, 'snapshot')} of {number_of(what.cells, 'cell')}, "
        f"{what.period:.4g} s apart; {number_of(grown.state.taken, 'step')}, {grown.state.refused} refused; "
        f"volume within {in_percent(grown.volume)}, area within {in_percent(grown.area)}"
    )


def _cut_off(folder: SeriesFolder) -> str:
    kept = "snapshots so far stay in" if folder.state.is_file() else "no snapshot yet in"
    return f"interrupted; {kept} {folder.path}; go on with --resume"


def _needs(what: Growth) -> Needs:
    return of_growth(what.cells, nodes_of(what.frequency), what.snapshots, what.flow * what.period)
