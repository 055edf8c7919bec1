"""`holosplat view`, the live view of `reconstruct --view`, and `compare` and `rehearse`, which take finished runs."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional

from ..checks import as_written, require
from ..io.reading import Reading, Told
from ..progress import FitProgress, FitState
from ..ranges import Many, Within, checked_dataclass
from .places import Output
from .sentence import put, say

if TYPE_CHECKING:
    from ..report.compare import Side
    from ..representations import Stored
    from ..show.server import LiveView
    from ..workflows.run_folder import RunFolder

Port = Annotated[int, Within(1024, 65535)]
"""Ports that anybody may listen on."""


@checked_dataclass
class LiveFlags:
    """The live view of a fit (extra view)."""

    view: bool = False
    """Show the object in the browser while it is fitted; the address, with its token, is printed."""
    port: Port = 8080
    """Port of the view on this machine; the next free one is taken."""


@dataclass(frozen=True)
class Follow:
    """What `reconstruct` tells while it runs."""

    on_progress: FitProgress
    on_state: FitState | None = None


@contextmanager
def watched(flags: LiveFlags, title: str, on_progress: FitProgress) -> Iterator[Follow]:
    """With --view, a view of a fit while it lasts, which is told what `on_progress` is."""
    if not flags.view:
        yield Follow(on_progress)
        return
    from ..show.server import LiveView, Watch

    page = LiveView(title, flags.port)
    try:
        page.tell("the start")
        say_where(page)
        watch = Watch(page)

        def both(stage: str, fraction: float, record: dict[str, float]) -> None:
            on_progress(stage, fraction, record)
            watch.on_progress(stage, fraction, record)

        yield Follow(both, watch.on_state)
    finally:
        page.close()


def say_where(page: LiveView) -> None:
    """Print the address of the page, with its token."""
    print(f"view: {page.url}", file=sys.stderr, flush=True)


INTERVAL_S = 1.0
"""Seconds from one look at a run that another process fits to the next."""


def view(what: Positional[Path], port: Port = 8080) -> None:
    """Show a run or an object file in the browser, as Gaussians or surfaces, with sliders (Ctrl-C ends).

    A run that another process fits is followed: its last checkpoint is shown, and each new one when it is there.

    The page is on this machine's own address only, and opens with the token in the address that is printed. On another
    machine, forward the port: ssh -L 8080:127.0.0.1:8080 THERE.

    Args:
        what: Run folder, or object file (object.h5, or one of export --compact, of a series too).
        port: Port; the next free one is taken.
    """
    from ..show.server import LiveView
    from ..workflows.run_folder import RunFolder, fitted_by

    folder = RunFolder(what)
    followed = what.is_dir() and fitted_by(folder) is not None
    objects, words, slider = ({}, [], "time") if followed else _objects(what)
    page = LiveView(what.resolve().name or "holosplat", port)
    try:
        if followed:
            _follow(page, folder)
        else:
            from ..show.scene import Scene

            Scene(page).put(objects, words, slider)
            say_where(page)
        _until_interrupted()
    except KeyboardInterrupt:
        pass
    finally:
        page.close()


def _follow(page: LiveView, folder: RunFolder) -> None:
    """Show what another process fits, until that ends."""
    from ..show.scene import Follow

    run = Follow(page, folder)
    say_where(page)
    while run.look():
        _pause()


def _pause() -> None:
    """Wait for the next look."""
    time.sleep(INTERVAL_S)


def _until_interrupted() -> None:
    """Wait for Ctrl-C."""
    threading.Event().wait()


def _objects(what: Path) -> tuple[dict[str, Stored], list[str], str]:
    """What a slider leads through, by its label: times, or a rehearsed run and its likely matter; words on it; and the
    slider's name."""
    from ..io.compact import SERIES
    from ..io.hdf5 import open_hdf5
    from ..io.objects import read_object, read_series
    from ..show.parts import at_times, likely_surfaces
    from ..show.scene import steps_of
    from ..workflows.reconstruction import instants_of
    from ..workflows.rehearsal import matter_of
    from ..workflows.run_folder import RunFolder

    require(what.exists(), f"{what} must be a run folder or an object file, but there is none; check the path.")
    if what.is_dir():
        folder = RunFolder(what)
        folder.require_run()
        obj, matter = folder.read_result(), matter_of(folder)
        likely = {} if matter is None else likely_surfaces(matter)
        words, slider = [obj.described, *steps_of(folder)], "shown" if likely else "time"
        return at_times(obj, instants_of(folder)) | likely, words, slider
    with open_hdf5(what) as file:
        several = file.attrs.get("format", "") == SERIES
    if several:
        series = read_series(what)
        return series, [f"{len(series)} objects"], "time"
    obj = read_object(what)
    return at_times(obj, ()), [obj.described], "time"


def compare(
    a: Positional[Path], b: Positional[Path], out: Output = Path("compare.html"), allow_external: bool = False
) -> None:
    """Compare two runs side by side: what was asked, decided and found, and where their volumes differ.

    Of runs of matter in motion, the first times are compared.

    Args:
        a: Run folder.
        b: Another one.
        out: Page to write (HTML), with slices of both volumes and their difference.
        allow_external: Follow links of the runs' scans to other files; only of files you trust.
    """
    from ..report.compare import Comparison, in_columns, write_comparison

    for path in (a, b):
        Told(allow_external=allow_external).vouch(path)
    comparison = Comparison(_side(a), _side(b))
    for table in (*comparison.found(), *comparison.asked()):
        print("\n".join(in_columns(table)))
    print(comparison.verdict())
    write_comparison(comparison, out)
    print(f"page: {out}")


def _side(path: Path) -> Side:
    """A run with its scores, as far as its scan is still there."""
    from ..io.atomic import read_json
    from ..io.reading import Part, Reading
    from ..report.compare import side_of
    from ..workflows.reconstruction import instants_of
    from ..workflows.run_folder import RunFolder
    from .scans import scan_for

    folder, scan = RunFolder(path), None
    folder.require_run()
    told = read_json(folder.source).get("scan") if folder.source.is_file() else None
    if told and Path(str(told)).exists():
        scan = scan_for(folder, None, Reading(part=Part(time_frame=0)) if instants_of(folder) else Reading())
    return side_of(folder, scan)


def rehearse(run: Positional[Path], times: Many = 8, bins: Many | None = None, reading: Reading = Reading()) -> None:
    """Say how sure the numbers of a run are: simulate its frames, reconstruct them likewise, and compare.

    The intervals and the verdict join summary.json and the report. Rehearsals that are there are not made again. Of a
    series, every time that is done is rehearsed, and its table is written again.

    Args:
        run: Run folder, or folder of a series of single times.
        times: Rehearsals, 2 or more.
        bins: Pixels joined along an edge, for speed (default: to about 48 pixels along the shorter side).
    """
    from ..series.collect import collect
    from ..series.folder import SeriesFolder
    from ..workflows.run_folder import RunFolder
    from .scans import runs_of

    each = runs_of(run)
    for number, (_, folder) in enumerate(each):
        if folder.result().is_file():
            say(f"time {number}:")
            _rehearse(folder, times, bins, reading)
    if each:
        collect(series := SeriesFolder(run))
        say(f"wrote {series.table}")
    else:
        _rehearse(RunFolder(run), times, bins, reading)


def _rehearse(folder: RunFolder, times: int, bins: int | None, reading: Reading) -> None:
    from ..methods.continued import Continued
    from ..methods.presets import method_of
    from ..methods.solve import Settled
    from ..report.run import report_run
    from ..series.plan import prior_of
    from ..tables import from_table
    from ..workflows.evaluate import evaluate as score
    from ..workflows.rehearsal import rehearse as repeat
    from ..workflows.run_folder import claimed
    from .progress import ProgressBar
    from .scans import run_and_scan

    result, measured = run_and_scan(folder, None, reading)
    config = folder.read_config()
    with as_written(folder.config, "what reconstruct wrote"):
        told = dict(config["method"])
        method = from_table(Continued, told) if told.get("kind") == Continued.kind else method_of(told, "method")
        method = Settled.again(method, config["decided"]).method
        prior, seed = prior_of(config["prior"]), int(config["seed"])
    with claimed(folder):
        with ProgressBar() as bar:
            how = {"times": times, "bins": bins, "seed": seed, "folder": folder, "on_progress": bar.show}
            found = repeat(result, measured, prior, method, **how)
        page = report_run(folder, result, measured, score(result, measured, None), None)
    put(found.lines())
    say(f"report: {page}")
