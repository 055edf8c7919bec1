"""Sentences on standard error, and the one with which a command ends that cannot do its work."""

from __future__ import annotations

import sys
from typing import NoReturn


def say(text: str) -> None:
    """Print `text` on standard error."""
    print(text, file=sys.stderr)


def give_up(sentence: str) -> NoReturn:
    """Say `sentence` on standard error, and end with 2."""
    text = f"holosplat: {sentence}\n"
    sys.stderr.write(text.encode("utf-8", "backslashreplace").decode("utf-8"))
    raise SystemExit(2) from None
