"""The live view of `reconstruct --view`."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

from ..progress import FitProgress, FitState
from ..ranges import Within, ranged

if TYPE_CHECKING:
    from ..show.server import LiveView

Port = Annotated[int, Within(1024, 65535)]
"""Ports that anybody may listen on."""


@dataclass(frozen=True)
@ranged
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
    on_state: FitState = lambda stage, fraction, record, state: None


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
