"""The sentence with which a command ends that cannot do what it was asked for."""

from __future__ import annotations

import sys
from typing import NoReturn


def give_up(sentence: str) -> NoReturn:
    """Say `sentence` on standard error, and end with 2."""
    text = f"holosplat: {sentence}\n"
    sys.stderr.write(text.encode("utf-8", "backslashreplace").decode("utf-8"))
    raise SystemExit(2) from None
