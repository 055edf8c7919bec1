"""An object on a page, with sliders for cuts and time; a run in progress is updated."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping, Sequence

from ..checks import InputError
from ..io.objects import read_object
from ..representations import Stored
from ..workflows.run_folder import RunFolder, fitted_by, read_status
from .parts import Frame, Shown, at_times, cut, shown, steps_of
from .server import LiveView

CUTS = 50
"""Steps of the slider that cuts matter away."""
BOX = 1000
"""Voxels of the grid that only says where the object lies."""


class Scene:
    """The scene of a page: one of several objects, chosen by a slider and cut by another one, which stay where they are
    when the objects are replaced."""

    def __init__(self, page: LiveView) -> None:
        self._page = page
        self._objects: Mapping[str, Stored] = {}
        self._words: Sequence[str] = ()
        self._parts = dict[int, Shown]()
        self._now = {"time": 0, "cut": 0}
        self._lock = threading.Lock()  # sliders are moved in another thread

    def put(self, objects: Mapping[str, Stored], words: Sequence[str], slider: str = "time") -> None:
        """Show `objects`, by what the `slider` says of each, and words below the title."""
        with self._lock:
            first = not self._objects
            self._objects, self._words, self._parts = objects, words, {}
            if first:
                self._page.frame = Frame.around(next(iter(objects.values())).enclosing_grid(BOX))
            self._draw()
        if first and len(objects) > 1:
            self._page.slider(slider, len(objects), lambda k: self._move(time=k))
        if first:
            self._page.slider("cut along z", CUTS, lambda k: self._move(cut=k))

    def say(self, words: Sequence[str]) -> None:
        """Other words below the title."""
        with self._lock:
            self._words = words
            self._tell()

    def _move(self, **changed: int) -> None:
        with self._lock:
            self._now.update(changed)
            self._draw()

    def _label(self) -> tuple[int, str]:
        """Which object is shown: its number, and its label."""
        labels = list(self._objects) or [""]
        number = min(self._now["time"], len(labels) - 1)
        return number, labels[number]

    def _draw(self) -> None:
        number, label = self._label()
        if number not in self._parts:
            self._parts[number] = shown(self._objects[label])
        self._page.show(cut(self._parts[number], 2, self._now["cut"] / CUTS))
        self._tell()

    def _tell(self) -> None:
        self._page.tell(*self._words, self._label()[1])


class Follow:
    """A run that another process fits: each new checkpoint is drawn if a browser is there. The folder is only read."""

    def __init__(self, page: LiveView, folder: RunFolder) -> None:
        self._page, self._folder, self._scene = page, folder, Scene(page)
        self._drawn: tuple[int, int] | None = None
        self._said: tuple[int, int] | None = None
        self._scene.say(["it has begun; nothing is kept yet"])

    def look(self) -> bool:
        """Show what there is; whether the run goes on."""
        try:
            writer = fitted_by(self._folder)
            if writer is not None:
                self._go_on(f"fitted by process {writer.process} on {writer.host}")
        except (InputError, OSError):  # files of two moments: they are replaced one after the other
            return True
        if writer is None:
            self._end()
        return writer is not None

    def _go_on(self, by: str) -> None:
        kept = self._kept()
        draws = kept != self._drawn and self._page.watched
        if kept is None or not (draws or kept != self._said):
            return
        found = read_status(self._folder)
        words = [*found.lines(), f"kept at {time.strftime('%H:%M:%S', time.localtime(kept[0] / 1e9))}", by]
        if draws and found.object is not None:
            self._scene.put(at_times(found.object, ()), [found.object.described, *words])
        else:
            self._scene.say(words)
        self._drawn, self._said = kept if draws else self._drawn, kept

    def _end(self) -> None:
        """What the run has ended with."""
        result = self._folder.result()
        if not result.is_file():
            self._scene.say(["the run was cut off; finish it with --resume"])
            return
        found = read_object(result)
        complete = self._folder.summary.is_file() and bool(self._folder.read_summary().get("finished"))
        how = "the run has ended" if complete else "the run was interrupted; it goes on with --resume"
        self._scene.put(at_times(found, ()), [found.described, *steps_of(self._folder), how])

    def _kept(self) -> tuple[int, int] | None:
        """What tells one checkpoint from another; None before the first."""
        try:
            found = self._folder.checkpoint.stat()
        except FileNotFoundError:
            return None
        return found.st_mtime_ns, found.st_size
