"""Sentences on standard error, and the one with which a command ends that cannot do its work."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import NoReturn

INTERRUPTED = 130
"""Exit code after Ctrl-C, as shells have it."""


def put(lines: Iterable[str]) -> None:
    """Print lines on standard output."""
    for line in lines:
        print(line)


def say(text: str) -> None:
    """Print `text` on standard error."""
    print(text, file=sys.stderr)


@contextmanager
def interruptible(sentence: Callable[[], str]) -> Iterator[None]:
    """In the block, Ctrl-C says a `sentence`, and ends with `INTERRUPTED`."""
    try:
        yield
    except KeyboardInterrupt:
        say(sentence())
        raise SystemExit(INTERRUPTED) from None


def give_up(sentence: str) -> NoReturn:
    """Say `sentence` on standard error, and end with 2."""
    text = f"holosplat: {sentence}\n"
    sys.stderr.write(text.encode("utf-8", "backslashreplace").decode("utf-8"))
    raise SystemExit(2) from None
