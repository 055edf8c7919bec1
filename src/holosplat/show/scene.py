"""An object on a page, with sliders that cut matter away and lead through time."""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence

from ..representations import Stored
from .parts import Frame, Shown, cut, shown
from .server import LiveView

CUTS = 50
"""Steps of the slider that cuts matter away."""
BOX = 1000
"""Voxels of the grid that only says where the object lies."""


class Scene:
    """The scene of a page: one of several objects, chosen by a slider and cut by another one.

    The objects may be replaced while it is shown; sliders stay where they are.
    """

    def __init__(self, page: LiveView) -> None:
        self._page = page
        self._objects: Mapping[str, Stored] = {}
        self._words: Sequence[str] = ()
        self._parts = dict[int, Shown]()
        self._now = {"time": 0, "cut": 0}
        self._lock = threading.Lock()  # sliders are moved in another thread

    def put(self, objects: Mapping[str, Stored], words: Sequence[str]) -> None:
        """Show `objects`, by what the slider of time says of each, and words below the title."""
        with self._lock:
            first = not self._objects
            self._objects, self._words, self._parts = objects, words, {}
            if first:
                self._page.frame = Frame.around(next(iter(objects.values())).enclosing_grid(BOX))
            self._draw()
        if first and len(objects) > 1:
            self._page.slider("time", len(objects), lambda k: self._move(time=k))
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
