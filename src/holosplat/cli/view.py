"""`holosplat view`."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import TYPE_CHECKING

from tyro.conf import Positional

from ..checks import require
from .live import Port, say_where

if TYPE_CHECKING:
    from ..representations import Stored
    from ..show.server import LiveView

CUTS = 50
"""Steps of the slider that cuts matter away."""
BOX = 1000
"""Voxels of the grid that only says where the object lies."""


def view(what: Positional[Path], port: Port = 8080) -> None:
    """Show a run or an object file in the browser, as Gaussians or surfaces, with sliders (Ctrl-C ends).

    The page is on this machine's own address only, and opens with the token in the address that is printed. On another
    machine, forward the port: ssh -L 8080:127.0.0.1:8080 THERE.

    Args:
        what: Run folder, or object file (object.h5, or one of export --compact, of a series too).
        port: Port; the next free one is taken.
    """
    from ..show.server import LiveView

    objects, words = _objects(what)
    page = LiveView(what.name or "holosplat", port)
    try:
        _shown(page, objects, words)
        say_where(page)
        _until_interrupted()
    except KeyboardInterrupt:
        pass
    finally:
        page.close()


def _until_interrupted() -> None:
    """Wait for Ctrl-C."""
    threading.Event().wait()


def _objects(what: Path) -> tuple[dict[str, Stored], list[str]]:
    """What the slider of time leads through, by its label, and words on the run."""
    from ..io.compact import SERIES
    from ..io.hdf5 import open_hdf5
    from ..io.objects import read_object
    from ..io.series import read_series
    from ..show.parts import at_times
    from ..workflows.moments import instants_of
    from ..workflows.run_folder import RunFolder

    require(what.exists(), f"{what} must be a run folder or an object file, but there is none; check the path.")
    if what.is_dir():
        folder = RunFolder(what)
        folder.require_run()
        obj = read_object(folder.result())
        losses = folder.history().get("loss")
        said = [] if losses is None or len(losses) == 0 else [f"step {len(losses)}, loss {losses[-1]:.4g}"]
        return at_times(obj, instants_of(folder)), [obj.described, *said]
    with open_hdf5(what) as file:
        several = file.attrs.get("format", "") == SERIES
    if several:
        series = read_series(what)
        return series, [f"{len(series)} objects"]
    obj = read_object(what)
    return at_times(obj, ()), [obj.described]


def _shown(page: LiveView, objects: dict[str, Stored], words: list[str]) -> None:
    """The first object, and the sliders."""
    from ..show.parts import Frame, cut, shown

    labels, parts = list(objects), dict[int, object]()
    page.frame = Frame.around(next(iter(objects.values())).enclosing_grid(BOX))
    now = {"time": 0, "cut": 0}

    def draw(**changed: int) -> None:
        now.update(changed)
        number = now["time"]
        if number not in parts:
            parts[number] = shown(objects[labels[number]])
        page.show(cut(parts[number], 2, now["cut"] / CUTS))  # pyright: ignore[reportArgumentType]
        page.tell(*words, labels[number])

    draw()
    if len(labels) > 1:
        page.slider("time", len(labels), lambda k: draw(time=k))
    page.slider("cut along z", CUTS, lambda k: draw(cut=k))
