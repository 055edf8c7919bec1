"""Pretended peers of the arena."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable

import numpy as np

from holosplat_bench.suite.arena.contest import Answer, Question

BUSY = "import time\nwhile time.process_time() < 0.15: pass"


def busy(question: Question) -> Callable[[], Answer]:
    """A tenth of a second here, at least as much in a child, and 200 MB."""

    def run() -> Answer:
        began = time.process_time()
        np.ones(25_000_000)
        while time.process_time() < began + 0.1:
            pass
        subprocess.run([sys.executable, "-S", "-c", BUSY], check=True)
        return {"lines": question.lines}

    return run


def right(question: Question) -> Callable[[], Answer]:
    """The true phase, from the file that the test names."""
    return lambda: {"lines": np.load(os.environ["ARENA_LINES"])}


def crash(question: Question) -> Callable[[], Answer]:
    """Dies as a segmentation fault or lack of memory would have it."""
    return lambda: os.kill(os.getpid(), signal.SIGKILL)  # type: ignore[return-value]


def slow(question: Question) -> Callable[[], Answer]:
    """Never answers."""
    return lambda: time.sleep(600)  # type: ignore[func-returns-value]


def wrong(question: Question) -> Callable[[], Answer]:
    """Refuses."""
    raise ValueError("several lines\nno such geometry")


def silent(question: Question) -> Callable[[], Answer]:
    """Ends well, without an answer."""
    return lambda: os._exit(0)


def other_shape(question: Question) -> Callable[[], Answer]:
    """Too few numbers."""
    return lambda: {"lines": question.lines[:1]}


def not_finite(question: Question) -> Callable[[], Answer]:
    """Not numbers."""
    return lambda: {"lines": np.full(question.frames.shape, np.nan)}
