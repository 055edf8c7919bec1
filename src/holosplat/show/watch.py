"""A fit that is watched: its object in a live view, at intervals that keep what this costs small."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from ..representations import Stored
from .parts import Frame, shown
from .server import LiveView

INTERVAL_S = 1.0
"""Seconds between updates, at least."""
SHARE = 0.01
"""Share of the time that updates may take by what they cost in this process; sending them comes beside it."""


class Watch:
    """Callbacks from a fit to a view: `on_progress` and `on_state` of `reconstruct`.

    The object is taken at the end of a step, of the first one of a stage always, and drawn by another thread. The next
    update waits until the last one's cost is `SHARE` of the time. While no browser is there, only words are kept, and
    nothing is drawn.
    """

    def __init__(self, view: LiveView) -> None:
        self._view = view
        self._next, self._cost, self._stage = 0.0, 0.0, ""
        self._busy = threading.Event()

    def on_progress(self, stage: str, fraction: float, record: dict[str, float]) -> None:
        """A stage that goes on, as words."""
        if not record and time.perf_counter() >= self._next:
            self._next = time.perf_counter() + INTERVAL_S
            self._view.tell(f"{stage}: {fraction:.0%}")

    def on_state(self, stage: str, fraction: float, record: dict[str, float], state: Callable[[], Stored]) -> None:
        """A step of a fit: words, and the object where a browser looks."""
        now = time.perf_counter()
        if (now < self._next and stage == self._stage) or self._busy.is_set():
            return
        self._stage, self._next = stage, now + INTERVAL_S
        self._view.tell(*words(stage, fraction, record))
        if not self._view.watched:
            return
        began = time.thread_time()
        found = state()
        self._cost = time.thread_time() - began
        self._busy.set()
        threading.Thread(target=self._draw, args=(found,), daemon=True).start()

    def _draw(self, found: Stored) -> None:
        began = time.thread_time()
        try:
            if self._view.frame is None:
                self._view.frame = Frame.around(found.enclosing_grid(1))
            self._view.show(shown(found))
        finally:
            cost = self._cost + time.thread_time() - began
            self._next = time.perf_counter() + max(INTERVAL_S, cost / SHARE)
            self._busy.clear()


def words(stage: str, fraction: float, record: dict[str, float]) -> list[str]:
    """The description of a step."""
    numbers = {name: record[name] for name in ("loss", "count") if name in record}
    said = [f"{stage}: {fraction:.0%}", f"step {record.get('step', 0):.0f}"]
    said += [f"loss {numbers['loss']:.4g}"] if "loss" in numbers else []
    return said + ([f"{numbers['count']:.0f} Gaussians"] if "count" in numbers else [])
