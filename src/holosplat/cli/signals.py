"""Signals that ask a process to end: they save as Ctrl-C does."""

from __future__ import annotations

import signal
import threading
from types import FrameType

ASKING = (signal.SIGTERM, signal.SIGHUP)
"""A cluster's warning before it kills, and a terminal that is gone."""


def end_as_on_interrupt() -> None:
    """From now on these signals do what Ctrl-C does, also where that is switched off, as in jobs of a shell's
    background; those that are ignored, as under nohup, stay ignored. Only a main thread can say so."""
    if threading.current_thread() is not threading.main_thread():
        return
    for number in ASKING:
        if signal.getsignal(number) is signal.SIG_DFL:
            signal.signal(number, _interrupt)


def _interrupt(number: int, frame: FrameType | None) -> None:
    action = signal.getsignal(signal.SIGINT)
    if not callable(action) or action is signal.SIG_IGN or action is signal.SIG_DFL:
        raise KeyboardInterrupt
    action(number, frame)
