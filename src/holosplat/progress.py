"""The functions that long acts call to say how far they are."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

Advance = Callable[[float], None]
"""Called with the fraction that is done, 0 to 1."""

Progress = Callable[[str, float], None]
"""Called with (stage, fraction done of it)."""

FitProgress = Callable[[str, float, dict[str, float]], None]
"""Called with (stage, fraction done of it, the last record of the fit or {})."""

FitState = Callable[[str, float, dict[str, float], Callable[[], Any]], None]
"""Called with (stage, fraction done of it, the record of a step, a function that gives the object as it is now): with
the coarse volume of `PICTURE` before all work, with what each stage begins and ends with (all with {} for the record),
and after each step of a fit."""

PICTURE = "first picture"
"""The stage of a coarse volume that is there at once, and no part of the result."""
