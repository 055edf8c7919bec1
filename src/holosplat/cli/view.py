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

from ..io.reading import Reading, Told
from ..progress import FitProgress, FitState
from ..ranges import Many, Within, checked_dataclass
from .places import Output
from .sentence import say_that_libraries_load

if TYPE_CHECKING:
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
    from ..show.parts import objects_of
    from ..show.server import LiveView
    from ..workflows.run_folder import RunFolder, fitted_by

    folder = RunFolder(what)
    followed = what.is_dir() and fitted_by(folder) is not None
    objects, words, slider = ({}, [], "time") if followed else objects_of(what)
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
    from .scans import side_of_run

    for path in (a, b):
        Told(allow_external=allow_external).vouch(path)
    comparison = Comparison(side_of_run(a), side_of_run(b))
    for table in (*comparison.found(), *comparison.asked()):
        print("\n".join(in_columns(table)))
    print(comparison.verdict())
    write_comparison(comparison, out)
    print(f"page: {out}")


def rehearse(run: Positional[Path], times: Many = 8, bins: Many | None = None, reading: Reading = Reading()) -> None:
    """Say how sure the numbers of a run are: simulate its frames, reconstruct them likewise, and compare.

    The intervals and the verdict join summary.json and the report. Rehearsals that are there are not made again. Of a
    series, every time that is done is rehearsed, and its table is written again.

    Args:
        run: Run folder, or folder of a series of single times.
        times: Rehearsals, 2 or more.
        bins: Pixels joined along an edge, for speed (default: to about 48 pixels along the shorter side).
    """
    say_that_libraries_load()
    from .scans import rehearse_each

    rehearse_each(run, times, bins, reading)
